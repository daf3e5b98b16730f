//! Weights of the motion model as plain arrays, and the folder they live in.
//!
//! A motion-model folder holds
//! * `motion.json`: [`MotionConfig`] - sizes, frames per second, canonical convention, hashes;
//! * `predictor.safetensors`: the marker predictor;
//! * `regressor.safetensors`: the body regressor.
//!
//! Tensors carry the names and layouts of the authors' PyTorch modules. `weight` of a dense layer is (out, in) row-major, y = W x + b.
//! A GRU has `weight_ih` (3H, I), `weight_hh` (3H, H), `bias_ih` (3H), `bias_hh` (3H) with gates in the order r, z, n:
//! r = s(Wr x + br + Ur h + cr), z = s(Wz x + bz + Uz h + cz), n = tanh(Wn x + bn + r * (Un h + cn)), h' = (1 - z) n + z h.
//!
//! | predictor | kind | in -> out | |
//! |---|---|---|---|
//! | `x_enc.*_l0` | GRU | frame -> hidden | seed frames, shared by encoder and decoder |
//! | `e_rnn.*_l0` | GRU | frame -> hidden | future frames |
//! | `e_mlp.layers.{0,1}` | dense + tanh | 2 hidden [h_x, h_y] -> wide -> hidden | |
//! | `e_mu`, `e_logvar` | dense | hidden -> latent | |
//! | `drnn_mlp.layers.{0,1,2}` | dense + tanh | hidden (h_x) -> wide -> hidden -> hidden | initial state of `d_rnn` |
//! | `d_rnn.*` | GRU cell | [h_x hidden, z latent, previous frame] -> hidden | |
//! | `d_mlp.layers.{0,1}` | dense + tanh | hidden -> wide -> hidden | |
//! | `d_out` | dense | hidden -> frame | frame = previous frame + this |
//!
//! | regressor | kind | in -> out | |
//! |---|---|---|---|
//! | `pnet.in_fc` | dense | [markers 201, betas 10, estimate 159] -> width | no activation |
//! | `pnet.layers.N.layers.{0,1}` | dense + relu | width -> width -> width | h = block(h) + h |
//! | `pnet.out_fc` | dense | width -> 159 | added to the estimate, which starts at zero; `passes` times |
//!
//! The 159 are: translation 3, 22 rotations x 6 (rows of a (3, 2) matrix, see `body::rotation`), hands 24.

use super::config::{CONTINUOUS, MotionConfig, PredictorSizes, RegressorSizes};
use super::layers::{Dense, Gru, Named, Parameters};
use crate::io::{Precision, Tensors, content_hash, pack_tensors, write_atomic};
use crate::{Error, Result};
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

/// File names of a motion-model folder.
pub const CONFIG_FILE: &str = "motion.json";
pub const PREDICTOR_FILE: &str = "predictor.safetensors";
pub const REGRESSOR_FILE: &str = "regressor.safetensors";

/// All weights of the marker predictor.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PredictorWeights {
    pub x_enc: Gru,
    pub e_rnn: Gru,
    pub e_mlp: [Dense; 2],
    pub e_mu: Dense,
    pub e_logvar: Dense,
    pub drnn_mlp: [Dense; 3],
    pub d_rnn: Gru,
    pub d_mlp: [Dense; 2],
    pub d_out: Dense,
}

/// All weights of the body regressor.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RegressorWeights {
    /// Passes over the network.
    pub passes: usize,
    pub in_fc: Dense,
    pub blocks: Vec<[Dense; 2]>,
    pub out_fc: Dense,
}

impl PredictorWeights {
    /// Reads all tensors and checks their shapes against `s`.
    pub fn read(t: &Tensors, s: PredictorSizes) -> Result<Self> {
        let (f, h, w) = (s.frame, s.hidden, s.wide);
        let dense = |name: &str, i, o| Dense::read(t, name, i, o);
        Ok(Self {
            x_enc: Gru::read(t, "x_enc", "_l0", f, h)?,
            e_rnn: Gru::read(t, "e_rnn", "_l0", f, h)?,
            e_mlp: [dense("e_mlp.layers.0", 2 * h, w)?, dense("e_mlp.layers.1", w, h)?],
            e_mu: dense("e_mu", h, s.latent)?,
            e_logvar: dense("e_logvar", h, s.latent)?,
            drnn_mlp: [dense("drnn_mlp.layers.0", h, w)?, dense("drnn_mlp.layers.1", w, h)?, dense("drnn_mlp.layers.2", h, h)?],
            d_rnn: Gru::read(t, "d_rnn", "", h + s.latent + f, h)?,
            d_mlp: [dense("d_mlp.layers.0", h, w)?, dense("d_mlp.layers.1", w, h)?],
            d_out: dense("d_out", h, f)?,
        })
    }

    /// All tensors under their file names.
    pub fn named(&self) -> Vec<Named> {
        let mut out = Vec::new();
        self.x_enc.put("x_enc", "_l0", &mut out);
        self.e_rnn.put("e_rnn", "_l0", &mut out);
        for (i, d) in self.e_mlp.iter().enumerate() {
            d.put(&format!("e_mlp.layers.{i}"), &mut out);
        }
        self.e_mu.put("e_mu", &mut out);
        self.e_logvar.put("e_logvar", &mut out);
        for (i, d) in self.drnn_mlp.iter().enumerate() {
            d.put(&format!("drnn_mlp.layers.{i}"), &mut out);
        }
        self.d_rnn.put("d_rnn", "", &mut out);
        for (i, d) in self.d_mlp.iter().enumerate() {
            d.put(&format!("d_mlp.layers.{i}"), &mut out);
        }
        self.d_out.put("d_out", &mut out);
        out
    }
}

impl Parameters for PredictorWeights {
    fn tensors_mut(&mut self) -> Vec<&mut Vec<f32>> {
        let Self { x_enc, e_rnn, e_mlp, e_mu, e_logvar, drnn_mlp, d_rnn, d_mlp, d_out } = self;
        let mut out: Vec<&mut Vec<f32>> = x_enc.tensors_mut().into_iter().chain(e_rnn.tensors_mut()).collect();
        out.extend(e_mlp.iter_mut().chain([e_mu, e_logvar]).chain(drnn_mlp).flat_map(Dense::tensors_mut));
        out.extend(d_rnn.tensors_mut());
        out.extend(d_mlp.iter_mut().chain([d_out]).flat_map(Dense::tensors_mut));
        out
    }
}

impl Parameters for RegressorWeights {
    fn tensors_mut(&mut self) -> Vec<&mut Vec<f32>> {
        let layers = std::iter::once(&mut self.in_fc).chain(self.blocks.iter_mut().flatten()).chain([&mut self.out_fc]);
        layers.flat_map(Dense::tensors_mut).collect()
    }
}

impl RegressorWeights {
    /// Reads all tensors and checks their shapes against `s`.
    pub fn read(t: &Tensors, s: RegressorSizes) -> Result<Self> {
        let block = |i: usize| -> Result<[Dense; 2]> {
            let layer = |k: usize| Dense::read(t, &format!("pnet.layers.{i}.layers.{k}"), s.width, s.width);
            Ok([layer(0)?, layer(1)?])
        };
        Ok(Self {
            passes: s.passes,
            in_fc: Dense::read(t, "pnet.in_fc", RegressorSizes::INPUT, s.width)?,
            blocks: (0..s.blocks).map(block).collect::<Result<_>>()?,
            out_fc: Dense::read(t, "pnet.out_fc", s.width, CONTINUOUS)?,
        })
    }

    /// All tensors under their file names.
    pub fn named(&self) -> Vec<Named> {
        let mut out = Vec::new();
        self.in_fc.put("pnet.in_fc", &mut out);
        for (i, block) in self.blocks.iter().enumerate() {
            for (k, d) in block.iter().enumerate() {
                d.put(&format!("pnet.layers.{i}.layers.{k}"), &mut out);
            }
        }
        self.out_fc.put("pnet.out_fc", &mut out);
        out
    }
}

/// A whole motion model: configuration, both networks, and the content hash that policies name.
#[derive(Clone, Debug)]
pub struct MotionWeights {
    pub config: MotionConfig,
    pub predictor: PredictorWeights,
    pub regressor: RegressorWeights,
    /// SHA-256 over the hashes of the three files' contents.
    pub hash: String,
}

impl MotionWeights {
    /// Reads a motion-model folder.
    ///
    /// # Errors
    /// Names the file and entry that is missing, malformed, or not of this program's time base or canonical convention.
    pub fn load(dir: impl AsRef<Path>) -> Result<Self> {
        let dir = dir.as_ref();
        let read = |name: &str| fs::read(dir.join(name)).map_err(|e| Error::io(dir.join(name), e));
        Self::from_bytes(dir, read(CONFIG_FILE)?, read(PREDICTOR_FILE)?, read(REGRESSOR_FILE)?)
    }

    /// Takes the contents of the three files of a folder; `dir` names it in errors.
    ///
    /// # Errors
    /// As [`MotionWeights::load`].
    pub fn from_bytes(dir: &Path, config: Vec<u8>, predictor: Vec<u8>, regressor: Vec<u8>) -> Result<Self> {
        let path = dir.join(CONFIG_FILE);
        let text = config;
        let config: MotionConfig = serde_json::from_slice(&text).map_err(|e| Error::file(&path, e.to_string()))?;
        config.check(&path)?;
        let p = Tensors::from_bytes(dir.join(PREDICTOR_FILE), predictor)?;
        let r = Tensors::from_bytes(dir.join(REGRESSOR_FILE), regressor)?;
        let hash = content_hash([content_hash(&text), p.hash(), r.hash()].concat().as_bytes());
        let predictor = PredictorWeights::read(&p, config.predictor)?;
        let regressor = RegressorWeights::read(&r, config.regressor)?;
        Ok(Self { config, predictor, regressor, hash })
    }

    /// Writes a motion-model folder, weights in half precision.
    pub fn save(dir: impl AsRef<Path>, config: &MotionConfig, predictor: &PredictorWeights, regressor: &RegressorWeights) -> Result<()> {
        Self::save_as(dir, config, predictor, regressor, Precision::Half)
    }

    /// Writes a motion-model folder with weights in that precision.
    pub fn save_as(
        dir: impl AsRef<Path>,
        config: &MotionConfig,
        predictor: &PredictorWeights,
        regressor: &RegressorWeights,
        precision: Precision,
    ) -> Result<()> {
        let dir = dir.as_ref();
        let none = BTreeMap::new();
        write_atomic(dir.join(PREDICTOR_FILE), &pack_tensors(&predictor.named(), &none, precision)?)?;
        write_atomic(dir.join(REGRESSOR_FILE), &pack_tensors(&regressor.named(), &none, precision)?)?;
        let mut text = serde_json::to_vec_pretty(config).map_err(|e| Error::invalid(format!("{CONFIG_FILE}: {e}")))?;
        text.push(b'\n');
        write_atomic(dir.join(CONFIG_FILE), &text)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::MARKER_DIM;

    #[test]
    fn folder_round_trip_and_checks() {
        let dir = tempfile::tempdir().unwrap();
        let mut config = MotionConfig::new("body");
        config.predictor = PredictorSizes { frame: MARKER_DIM, hidden: 4, wide: 6, latent: 3 };
        config.regressor = RegressorSizes { width: 5, blocks: 2, passes: 3 };
        let mut k = 0.0;
        let mut dense = |input: usize, output: usize| {
            k += 1.0;
            Dense { input, output, weight: vec![k; input * output], bias: vec![-k; output] }
        };
        let gru = |input: usize, v: f32| Gru {
            input,
            hidden: 4,
            weight_ih: vec![v; 12 * input],
            weight_hh: vec![2.0 * v; 48],
            bias_ih: vec![3.0 * v; 12],
            bias_hh: vec![4.0 * v; 12],
        };
        let predictor = PredictorWeights {
            x_enc: gru(201, 0.5),
            e_rnn: gru(201, 0.25),
            e_mlp: [dense(8, 6), dense(6, 4)],
            e_mu: dense(4, 3),
            e_logvar: dense(4, 3),
            drnn_mlp: [dense(4, 6), dense(6, 4), dense(4, 4)],
            d_rnn: gru(4 + 3 + 201, 0.125),
            d_mlp: [dense(4, 6), dense(6, 4)],
            d_out: dense(4, 201),
        };
        let regressor = RegressorWeights {
            passes: 3,
            in_fc: dense(370, 5),
            blocks: vec![[dense(5, 5), dense(5, 5)], [dense(5, 5), dense(5, 5)]],
            out_fc: dense(5, 159),
        };
        let (mut p, mut r) = (predictor.clone(), regressor.clone());
        assert!(p.tensors_mut().into_iter().zip(predictor.named()).all(|(a, (_, _, b))| *a == b));
        assert!(r.tensors_mut().into_iter().zip(regressor.named()).all(|(a, (_, _, b))| *a == b));
        MotionWeights::save(dir.path(), &config, &predictor, &regressor).unwrap();
        let back = MotionWeights::load(dir.path()).unwrap();
        assert_eq!((&back.config, &back.predictor, &back.regressor), (&config, &predictor, &regressor));

        config.regressor.width = 6;
        write_atomic(dir.path().join(CONFIG_FILE), &serde_json::to_vec(&config).unwrap()).unwrap();
        let e = MotionWeights::load(dir.path()).unwrap_err().to_string();
        assert!(e.contains("regressor.safetensors") && e.contains("pnet.in_fc.weight") && e.contains("[6, 370]"), "{e}");
        let text = serde_json::to_string(&config).unwrap().replace("floor", "head");
        write_atomic(dir.path().join(CONFIG_FILE), text.as_bytes()).unwrap();
        let e = MotionWeights::load(dir.path()).unwrap_err().to_string();
        assert!(e.contains("motion.json") && e.contains("`head`, expected `floor` or `pelvis`"), "{e}");
    }
}
