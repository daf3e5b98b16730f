//! The authors' networks, as their PyTorch checkpoints hold them, in this project's types.
//!
//! Layers, names and layouts are the same (see [`super::weights`]); two conventions are not:
//! * their regressor reads [markers, estimate, betas], ours [markers, betas, estimate]: its first layer's columns are put into our order;
//! * their canonical frames have the origin at the pelvis: [`Origin::Pelvis`].
//!
//! Files: predictor `epoch-400.ckp` and regressor `epoch-100.ckp`, {epoch, model_state_dict, optimizer_state_dict}. A regressor belongs
//! to the body of one gender; it must give rotations in continuous form (159 numbers a body).

use super::config::{MotionConfig, Origin, PredictorSizes, RegressorSizes};
use super::weights::{MotionWeights, PredictorWeights, RegressorWeights};
use crate::body::{BETAS, BodyModel, MARKER_DIM};
use crate::io::Precision;
use crate::{Error, Result, torch};
use std::path::Path;

/// The marker predictor in the checkpoint `path`; sizes are those of its tensors.
///
/// # Errors
/// Names the file and the tensor that is missing or does not fit the others.
pub fn read_predictor(path: impl AsRef<Path>) -> Result<(PredictorSizes, PredictorWeights)> {
    const PARTS: [&str; 9] = ["x_enc.", "e_rnn.", "e_mlp.", "e_mu.", "e_logvar.", "drnn_mlp.", "d_rnn.", "d_mlp.", "d_out."];
    let t = torch::read(path, |name| PARTS.iter().any(|p| name.starts_with(p)))?;
    let sizes = PredictorSizes::of(&t)?;
    if sizes.frame != MARKER_DIM {
        let what = format!("tensor 'x_enc.weight_ih_l0' reads frames of {} numbers, expected {MARKER_DIM} (67 markers)", sizes.frame);
        return Err(Error::file(t.origin(), what));
    }
    Ok((sizes, PredictorWeights::read(&t, sizes)?))
}

/// The body regressor in the checkpoint `path`, its first layer in our order; sizes are those of its tensors, three passes.
///
/// # Errors
/// As [`read_predictor`].
pub fn read_regressor(path: impl AsRef<Path>) -> Result<(RegressorSizes, RegressorWeights)> {
    let t = torch::read(path, |name| name.starts_with("pnet."))?;
    let sizes = RegressorSizes::of(&t)?;
    let mut weights = RegressorWeights::read(&t, sizes)?;
    for row in weights.in_fc.weight.chunks_exact_mut(RegressorSizes::INPUT) {
        row[MARKER_DIM..].rotate_right(BETAS);
    }
    Ok((sizes, weights))
}

/// Makes the motion-model folder `out` of both networks (in single precision) and of the body asset `body` whose markers they have
/// learned, which is copied into it.
///
/// # Errors
/// As [`read_predictor`] and [`BodyModel::load`]; then nothing is written.
pub fn import(predictor: &Path, regressor: &Path, body: &Path, out: &Path) -> Result<MotionWeights> {
    let (p, r) = (read_predictor(predictor)?, read_regressor(regressor)?);
    let model = BodyModel::load(body)?;
    let config = MotionConfig { canonical: Origin::Pelvis, predictor: p.0, regressor: r.0, ..MotionConfig::new(model.hash()) };
    BodyModel::put_beside(body, out)?;
    MotionWeights::save_as(out, &config, &p.1, &r.1, Precision::Full)?;
    MotionWeights::load(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::Tensors;
    use crate::kernels::MotionEngine;
    use crate::motion::{FUTURE, MotionModel, Predictor, Regressor};
    use burn::tensor::{Device, Tensor, TensorData};
    use std::path::PathBuf;

    fn file(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/assets").join(name)
    }

    fn expected(name: &str) -> (Vec<f32>, Vec<usize>) {
        let t = Tensors::read(file("expected.safetensors")).unwrap();
        let shape = t.shape(name).unwrap();
        (t.f32s(name, &shape).unwrap(), shape)
    }

    fn tensor<const D: usize>(name: &str) -> Tensor<D> {
        let (data, shape) = expected(name);
        Tensor::from_data(TensorData::new(data, shape), &Device::flex())
    }

    fn near(have: &[f32], name: &str) {
        let (want, _) = expected(name);
        assert_eq!(have.len(), want.len(), "{name}");
        let worst = have.iter().zip(&want).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(worst < 1e-4, "{name} is off by {worst}");
    }

    fn floats<const D: usize>(t: Tensor<D>) -> Vec<f32> {
        t.into_data().try_to_vec().unwrap()
    }

    #[test]
    fn networks_give_what_torch_gives() {
        let (sizes, weights) = read_predictor(file("predictor.ckp")).unwrap();
        assert_eq!(sizes, PredictorSizes { frame: MARKER_DIM, hidden: 4, wide: 6, latent: 3 });
        let net = Predictor::new(&weights, &Device::flex());
        let (mu, logvar) = net.encode(tensor("predictor.seed"), tensor("predictor.future"));
        near(&floats(mu), "predictor.mu");
        near(&floats(logvar), "predictor.logvar");
        near(&floats(net.decode(tensor("predictor.seed"), tensor("predictor.latent"), FUTURE)), "predictor.decoded");
        let (sizes, weights) = read_regressor(file("regressor.ckp")).unwrap();
        assert_eq!(sizes, RegressorSizes { width: 5, blocks: 2, passes: 3 });
        let net = Regressor::new(&weights, &Device::flex());
        near(&floats(net.forward(tensor("regressor.markers"), tensor("regressor.betas"))), "regressor.body");
    }

    #[test]
    fn an_imported_folder_gives_it_too() {
        let dir = tempfile::tempdir().unwrap();
        let body = Path::new(env!("CARGO_MANIFEST_DIR")).join("checkpoints/body/body.safetensors");
        let weights = import(&file("predictor.ckp"), &file("regressor.ckp"), &body, dir.path()).unwrap();
        assert_eq!(weights.config.canonical, Origin::Pelvis);
        assert_eq!(weights.config.body, BodyModel::beside(dir.path()).unwrap().hash());
        let engine = MotionEngine::new(&weights).unwrap();
        assert_eq!(engine.origin(), Origin::Pelvis);
        let ((seed, _), (latent, _)) = (expected("predictor.seed"), expected("predictor.latent"));
        let mut out = vec![0.0; 3 * FUTURE * MARKER_DIM];
        engine.decode(&seed, &latent, &mut out).unwrap();
        near(&out, "predictor.decoded");
    }

    #[test]
    fn files_of_something_else_are_refused() {
        let refused = |error: Error, words: &[&str]| {
            let e = error.to_string();
            assert!(words.iter().all(|w| e.contains(w)), "{e}");
        };
        refused(
            read_predictor(file("regressor.ckp")).unwrap_err(),
            &["regressor.ckp", "none of the tensors", "model_state_dict.pnet.in_fc"],
        );
        refused(read_regressor(file("vposer_v2.ckpt")).unwrap_err(), &["vposer_v2.ckpt", "state_dict.vp_model."]);
        refused(read_predictor(file("missing.ckp")).unwrap_err(), &["missing.ckp", "No such file"]);
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("out");
        assert!(import(&file("predictor.ckp"), &file("regressor.ckp"), &file("policy.pth"), &out).is_err());
        assert!(!out.exists(), "nothing is left behind");
    }
}
