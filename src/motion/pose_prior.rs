//! A pose prior of VPoser's form: how far a body pose lies from those it has learned (eq. 9).
//!
//! Files hold the tensors of VPoser v1 or v2 under their own names, in safetensors or in the checkpoints that are published (v1 `.pt`,
//! v2 `.ckpt`); ours have v1's:
//!
//! | tensor (v1; `.weight`, `.bias`) | v2, after `vp_model.` if there | in -> out | |
//! |---|---|---|---|
//! | `bodyprior_enc_bn1` (also `.running_mean`, `.running_var`) | `encoder_net.1` | 63 | batch normalisation |
//! | `bodyprior_enc_fc1` | `encoder_net.2` | 63 -> 512 | leaky ReLU, slope 0.2 (v2: 0.01) |
//! | `bodyprior_enc_bn2` | `encoder_net.4` | 512 | batch normalisation |
//! | `bodyprior_enc_fc2` | `encoder_net.6` | 512 -> 512 | leaky ReLU 0.2 (v2: none) |
//! | | `encoder_net.7` | 512 -> 512 | |
//! | `bodyprior_enc_mu`, `bodyprior_enc_logvar` | `encoder_net.8.mu`, `.logvar` | 512 -> 32 | mean; deviation = softplus of the second |
//! | `bodyprior_dec_fc1`, `bodyprior_dec_fc2` | `decoder_net.0`, `.3` | 32 -> 512 -> 512 | leaky ReLU |
//! | `bodyprior_dec_out` | `decoder_net.5` | 512 -> 126 | 21 rotations x 6, see `body::rotation` |

use super::Dense;
use crate::body::PARAMS;
use crate::io::Tensors;
use crate::kernels::{Activation, Linear, Source, View, ViewMut};
use crate::{Error, Result, torch};
use std::ops::Range;
use std::path::Path;
use std::sync::{Arc, OnceLock};

/// Where the body pose (21 joints x axis-angle) lies within the 93 parameters of a body.
pub const POSE: Range<usize> = 6..69;
/// Floats of a body pose.
pub const POSE_DIM: usize = POSE.end - POSE.start;
/// Width of the embedding.
pub const POSE_LATENT: usize = 32;
/// Metadata entry with the threshold of eq. 9 that belongs to a file.
pub const THRESHOLD: &str = "threshold";
/// The paper's threshold, which belongs to VPoser v1.
const VPOSER_THRESHOLD: f32 = 11.0;
/// What torch adds to the variance in batch normalisation.
const BN_EPS: f32 = 1e-5;

type Layer = (Linear, Activation);

/// The prior, ready to use.
#[derive(Clone, Debug)]
pub struct PosePrior {
    encoder: Vec<Layer>,
    decoder: Vec<Layer>,
    threshold: f32,
    hash: String,
}

impl PosePrior {
    /// The shipped prior.
    ///
    /// # Errors
    /// If the program was built with a damaged file.
    pub fn embedded() -> Result<Arc<Self>> {
        static SHIPPED: OnceLock<Arc<PosePrior>> = OnceLock::new();
        if let Some(prior) = SHIPPED.get() {
            return Ok(prior.clone());
        }
        let bytes = include_bytes!("../../checkpoints/pose/pose.safetensors");
        let prior = Arc::new(Self::from_tensors(&Tensors::from_bytes("checkpoints/pose/pose.safetensors", bytes.to_vec())?)?);
        Ok(SHIPPED.get_or_init(|| prior).clone())
    }

    /// Reads the prior at `path`: safetensors or a checkpoint of PyTorch, by its extension; names as above.
    ///
    /// # Errors
    /// Names the file and the tensor that is missing or of another shape.
    pub fn load(path: impl AsRef<Path>) -> Result<Self> {
        const PARTS: [&str; 4] = ["bodyprior_", "vp_model.", "encoder_net.", "decoder_net."];
        let path = path.as_ref();
        let wanted = |name: &str| PARTS.iter().any(|p| name.starts_with(p));
        Self::from_tensors(&if torch::is_checkpoint(path) { torch::read(path, wanted)? } else { Tensors::read(path)? })
    }

    /// Takes the tensors of a file; see the module's table.
    ///
    /// # Errors
    /// As [`PosePrior::load`].
    pub fn from_tensors(t: &Tensors) -> Result<Self> {
        let v1 = t.names().iter().any(|n| n.starts_with("bodyprior_enc"));
        let (encoder, decoder) = if v1 { read_v1(t)? } else { read_v2(t)? };
        let threshold =
            match t.metadata().get(THRESHOLD) {
                None => VPOSER_THRESHOLD,
                Some(text) => text.parse().ok().filter(|v: &f32| *v > 0.0).ok_or_else(|| {
                    Error::file(t.origin(), format!("metadata entry '{THRESHOLD}' is '{text}', expected a positive number"))
                })?,
            };
        Ok(Self { encoder, decoder, threshold, hash: t.hash() })
    }

    /// Norm of the embedding below which eq. 9 calls a pose natural.
    pub fn threshold(&self) -> f32 {
        self.threshold
    }

    /// Content hash of the file.
    pub fn hash(&self) -> &str {
        &self.hash
    }

    /// Means (n x 32) of the embeddings of `poses` (n x 63, axis-angle, radians).
    pub fn encode(&self, poses: &[f32]) -> Vec<f32> {
        run(&self.encoder, poses, POSE_DIM)
    }

    /// Poses (n x 126: 21 rotations of 6 numbers) of embeddings `z` (n x 32).
    pub fn decode(&self, z: &[f32]) -> Vec<f32> {
        run(&self.decoder, z, POSE_LATENT)
    }

    /// ||VP|| of each body of `params` (n x 93): the norm of the mean of its pose's embedding.
    pub fn norms(&self, params: &[f32]) -> Vec<f32> {
        let poses: Vec<f32> = params.chunks_exact(PARAMS).flat_map(|p| &p[POSE]).copied().collect();
        self.encode(&poses).chunks_exact(POSE_LATENT).map(|mu| mu.iter().map(|v| v * v).sum::<f32>().sqrt()).collect()
    }
}

fn run(layers: &[Layer], x: &[f32], width: usize) -> Vec<f32> {
    let rows = x.len() / width;
    layers.iter().fold(x.to_vec(), |x, (layer, activation)| {
        let mut y = vec![0.0; rows * layer.outputs()];
        layer.forward(rows, View::new(&x, layer.inputs()), ViewMut::new(&mut y, layer.outputs()), Source::Fresh, *activation);
        y
    })
}

type Coders = (Vec<Layer>, Vec<Layer>);

fn read_v1(t: &Tensors) -> Result<Coders> {
    let leaky = Activation::LeakyRelu(0.2);
    let width = t.shape("bodyprior_enc_fc1.bias")?.first().copied().unwrap_or(0);
    let dense = |name: &str, i, o| Dense::read(t, &format!("bodyprior_{name}"), i, o);
    let first = normalised(t, "bodyprior_enc_bn1", dense("enc_fc1", POSE_DIM, width)?)?;
    let second = normalised(t, "bodyprior_enc_bn2", dense("enc_fc2", width, width)?)?;
    let encoder = vec![(first, leaky), (second, leaky), (dense("enc_mu", width, POSE_LATENT)?, Activation::None)];
    let decoder = vec![
        (dense("dec_fc1", POSE_LATENT, width)?, leaky),
        (dense("dec_fc2", width, width)?, leaky),
        (dense("dec_out", width, 2 * POSE_DIM)?, Activation::None),
    ];
    Ok((pack(encoder)?, pack(decoder)?))
}

fn read_v2(t: &Tensors) -> Result<Coders> {
    let leaky = Activation::LeakyRelu(0.01);
    let prefix = if t.names().iter().any(|n| n.starts_with("vp_model.")) { "vp_model." } else { "" };
    let width = t.shape(&format!("{prefix}encoder_net.2.bias"))?.first().copied().unwrap_or(0);
    let dense = |name: &str, i, o| Dense::read(t, &format!("{prefix}{name}"), i, o);
    let first = normalised(t, &format!("{prefix}encoder_net.1"), dense("encoder_net.2", POSE_DIM, width)?)?;
    let second = normalised(t, &format!("{prefix}encoder_net.4"), dense("encoder_net.6", width, width)?)?;
    let encoder = vec![
        (first, leaky),
        (second, Activation::None),
        (dense("encoder_net.7", width, width)?, Activation::None),
        (dense("encoder_net.8.mu", width, POSE_LATENT)?, Activation::None),
    ];
    let decoder = vec![
        (dense("decoder_net.0", POSE_LATENT, width)?, leaky),
        (dense("decoder_net.3", width, width)?, leaky),
        (dense("decoder_net.5", width, 2 * POSE_DIM)?, Activation::None),
    ];
    Ok((pack(encoder)?, pack(decoder)?))
}

fn pack(layers: Vec<(Dense, Activation)>) -> Result<Vec<Layer>> {
    layers.into_iter().map(|(d, a)| Ok((Linear::new(&d.weight, &d.bias, d.input)?, a))).collect()
}

/// `layer` behind the batch normalisation `name`: W (s x + h) + b with s = weight / sqrt(var + eps), h = bias - mean s.
fn normalised(t: &Tensors, name: &str, mut layer: Dense) -> Result<Dense> {
    let n = layer.input;
    let read = |part: &str| t.f32s(&format!("{name}.{part}"), &[n]);
    let (weight, bias, mean, var) = (read("weight")?, read("bias")?, read("running_mean")?, read("running_var")?);
    let scale: Vec<f32> = weight.iter().zip(&var).map(|(w, v)| w / (v + BN_EPS).sqrt()).collect();
    for (row, b) in layer.weight.chunks_exact_mut(n).zip(&mut layer.bias) {
        for (i, w) in row.iter_mut().enumerate() {
            *b += *w * (bias[i] - mean[i] * scale[i]);
            *w *= scale[i];
        }
    }
    Ok(layer)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Both versions at reduced width with batch statistics, made by torch.
    fn fixture(version: &str) -> Tensors {
        Tensors::read(format!("{}/tests/fixtures/vposer_{version}.safetensors", env!("CARGO_MANIFEST_DIR"))).unwrap()
    }

    #[test]
    fn both_versions_match_torch() {
        for version in ["v1", "v2"] {
            let t = fixture(version);
            let prior = PosePrior::from_tensors(&t).unwrap();
            assert_eq!(prior.threshold(), 11.0);
            let input = |name: &str, width: usize| t.f32s(name, &[4, width]).unwrap();
            for (have, want) in [
                (prior.encode(&input("poses", POSE_DIM)), input("mu", POSE_LATENT)),
                (prior.decode(&input("latents", POSE_LATENT)), input("rotations", 2 * POSE_DIM)),
            ] {
                let worst = have.iter().zip(&want).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                assert!(worst < 1e-4, "{version} is off by {worst}");
            }
            let mut params = vec![9.0; 4 * PARAMS];
            params
                .chunks_exact_mut(PARAMS)
                .zip(input("poses", POSE_DIM).chunks_exact(POSE_DIM))
                .for_each(|(p, pose)| p[POSE].copy_from_slice(pose));
            let norm = input("mu", POSE_LATENT)[..POSE_LATENT].iter().map(|v| v * v).sum::<f32>().sqrt();
            assert!((prior.norms(&params)[0] - norm).abs() < 1e-3);
        }
    }

    #[test]
    fn published_files_match_torch() {
        let file = |name: &str| Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/assets").join(name);
        let t = Tensors::read(file("expected.safetensors")).unwrap();
        for (version, name) in [("v1", "vposer_v1.pt"), ("v2", "vposer_v2.ckpt")] {
            let prior = PosePrior::load(file(name)).unwrap();
            assert_eq!(prior.threshold(), 11.0);
            let get = |name: &str, width: usize| t.f32s(&format!("{version}.{name}"), &[4, width]).unwrap();
            for (have, want) in [
                (prior.encode(&get("poses", POSE_DIM)), get("mu", POSE_LATENT)),
                (prior.decode(&get("latents", POSE_LATENT)), get("rotations", 2 * POSE_DIM)),
            ] {
                let worst = have.iter().zip(&want).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                assert!(worst < 1e-4, "{name} is off by {worst}");
            }
        }
    }

    #[test]
    fn a_file_of_something_else_is_refused() {
        let t = Tensors::read(format!("{}/tests/fixtures/gru.safetensors", env!("CARGO_MANIFEST_DIR"))).unwrap();
        let e = PosePrior::from_tensors(&t).unwrap_err().to_string();
        assert!(e.contains("gru.safetensors") && e.contains("encoder_net.2.bias"), "{e}");
    }
}
