//! The networks must say the same on every device of this build. Run with `--features ndarray` to compare two.
#![cfg(feature = "ndarray")]

use burn::tensor::{Device, Tensor, TensorData};
use egogen::DeviceChoice;
use egogen::agent::{Network, ObsGroup, ObsLayout, PolicyConfig, PolicySpec};
use egogen::body::{BETAS, BodyModel, MARKER_DIM};
use egogen::motion::{FUTURE, LATENT, MotionWeights, Predictor, Regressor, SEED};
use egogen::rng::stream;
use rand_distr::{Distribution, StandardNormal};
use std::collections::BTreeMap;

/// The paper's policy at a quarter of its width: two GRUs, encoded scalars, residual blocks.
fn policy() -> PolicySpec {
    let group = |name: &str, shape: &[usize]| ObsGroup { name: name.into(), shape: shape.into() };
    let layout = ObsLayout::new(vec![group("state", &[2, 402]), group("egosensing", &[2, 32]), group("dist", &[1]), group("time", &[1])]);
    let config = PolicyConfig { gru: BTreeMap::from([("state".into(), 128), ("egosensing".into(), 128)]), ..Default::default() };
    PolicySpec::new(config, layout, 128).expect("sizes are good")
}

/// Outputs of the policy and the gradient of a loss that touches all of them.
fn outputs_and_gradient(spec: &PolicySpec, flat: &[f32], obs: &[f32], device: Device) -> (Vec<f32>, Vec<f32>) {
    let network = Network::new(spec, flat, &device.autodiff());
    let out = network.forward(obs);
    let logvar = out.logvar.expect("the actions are continuous");
    let mut all = Vec::new();
    for part in [out.mu.clone().into_data(), logvar.clone().into_data(), out.value.clone().into_data()] {
        all.extend_from_slice(part.as_slice::<f32>().expect("outputs are f32"));
    }
    let loss = out.mu.powf_scalar(2.0).mean() + logvar.exp().mean() + (out.value - 1.0).powf_scalar(2.0).mean();
    let mut gradient = vec![0.0; spec.params()];
    network.add_gradients(&mut loss.backward(), &mut gradient);
    (all, gradient)
}

fn assert_close(a: &[f32], b: &[f32], what: &str) {
    let scale = a.iter().fold(0.0f32, |m, x| m.max(x.abs()));
    let worst = a.iter().zip(b).fold(0.0f32, |m, (x, y)| m.max((x - y).abs()));
    assert!(scale > 0.0 && worst <= 1e-4 * scale, "{what} differ by {worst} at a scale of {scale}");
}

#[test]
fn ndarray_agrees_with_flex_on_the_policy() {
    let spec = policy();
    let flat = spec.init(1);
    let obs: Vec<f32> = StandardNormal.sample_iter(stream(1, "devices", 0)).take(33 * spec.layout.dim()).collect();
    let device = |choice: DeviceChoice| choice.device().expect("built in");
    let (flex, flex_gradient) = outputs_and_gradient(&spec, &flat, &obs, device(DeviceChoice::Flex));
    let (ndarray, ndarray_gradient) = outputs_and_gradient(&spec, &flat, &obs, device(DeviceChoice::NdArray));
    assert_close(&flex, &ndarray, "outputs");
    assert_close(&flex_gradient, &ndarray_gradient, "gradients");
}

/// Two decoded primitives of the shipped predictor and the regressor's estimate for their frames.
fn motion_outputs(weights: &MotionWeights, device: &Device) -> (Vec<f32>, Vec<f32>) {
    let draw = |purpose: &str, n: usize| -> Vec<f32> { StandardNormal.sample_iter(stream(2, purpose, 0)).take(n).collect() };
    let shaped = BodyModel::embedded().shape(&[0.0; BETAS]);
    // A body at rest stands for a seed; only equal treatment is asked for here.
    let seed: Vec<f32> = shaped.rest_markers().iter().flat_map(|m| m.to_array()).collect::<Vec<_>>().repeat(4);
    let predictor = Predictor::new(&weights.predictor, device);
    let seed = Tensor::<3>::from_data(TensorData::new(seed, [2, SEED, MARKER_DIM]), device);
    let z = Tensor::<2>::from_data(TensorData::new(draw("latents", 2 * LATENT), [2, LATENT]), device);
    let frames = predictor.decode(seed, z, FUTURE);
    let betas = Tensor::<2>::zeros([2 * FUTURE, BETAS], device);
    let bodies = Regressor::new(&weights.regressor, device).forward(frames.clone().reshape([2 * FUTURE, MARKER_DIM]), betas);
    let floats = |data: TensorData| data.as_slice::<f32>().expect("outputs are f32").to_vec();
    (floats(frames.into_data()), floats(bodies.into_data()))
}

#[test]
fn ndarray_agrees_with_flex_on_the_motion_model() {
    let weights = MotionWeights::load(concat!(env!("CARGO_MANIFEST_DIR"), "/checkpoints/motion")).expect("the shipped model is whole");
    let outputs = |choice: DeviceChoice| motion_outputs(&weights, &choice.device().expect("built in"));
    let (flex, ndarray) = (outputs(DeviceChoice::Flex), outputs(DeviceChoice::NdArray));
    assert_close(&flex.0, &ndarray.0, "markers");
    assert_close(&flex.1, &ndarray.1, "bodies");
}
