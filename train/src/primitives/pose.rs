//! Training of the pose prior (VPoser's form, see `egogen::motion::pose_prior`) on the poses of the motion model's data.

use super::adam::{Adam, merge};
use super::init::dense as fresh;
use super::layers::{dense, dense_back, dense_grad};
use super::loss::sign;
use super::regressor::back_6d;
use super::sample::normals;
use egogen::Result;
use egogen::body::rotation::{from_6d, from_axis_angle, to_axis_angle};
use egogen::body::{BODY_JOINTS, PARAMS};
use egogen::io::{Precision, pack_tensors};
use egogen::kernels::Activation;
use egogen::motion::pose_prior::{POSE, POSE_DIM, POSE_LATENT, THRESHOLD};
use egogen::motion::{Dense, MotionSet, Named, Parameters, PosePrior};
use egogen::rng::{Stream, stream};
use glam::{Mat3, Vec3};
use rand::RngExt;
use rayon::prelude::*;
use serde::Serialize;
use std::collections::BTreeMap;

const WIDTH: usize = 512;
const SLOPE: f32 = 0.2;
const ROWS: usize = 256;
const SHARD: usize = 32;
/// Weight of the divergence, summed over the embedding, beside the absolute error of the 189 matrix entries, summed over joints'
/// means: VPoser's 0.005.
const KL: f32 = 0.005;
const RATES: [f32; 2] = [1e-3, 1e-5];
/// Poses are distorted by turning every joint about a random axis by N(0, this), radians (20 degrees).
pub const DISTORTION: f32 = 0.349;

/// The trainable layers.
#[derive(Clone)]
struct Weights {
    layers: [Dense; 7],
}

const NAMES: [&str; 7] = ["enc_fc1", "enc_fc2", "enc_mu", "enc_logvar", "dec_fc1", "dec_fc2", "dec_out"];
const FC1: usize = 0;
const FC2: usize = 1;
const MU: usize = 2;
const SPREAD: usize = 3;
const D1: usize = 4;
const D2: usize = 5;
const OUT: usize = 6;

impl Parameters for Weights {
    fn tensors_mut(&mut self) -> Vec<&mut Vec<f32>> {
        self.layers.iter_mut().flat_map(|d| [&mut d.weight, &mut d.bias]).collect()
    }
}

/// What the encoder does to a pose before its first layer: (x - mean) / sqrt(var).
struct Normal {
    mean: Vec<f32>,
    var: Vec<f32>,
}

/// One forward pass; the activations behind each layer, rows x outputs.
#[derive(Default)]
struct Tape {
    y: [Vec<f32>; 7],
    z: Vec<f32>,
}

/// Sums over a shard: error of rotation matrices and divergence, as in [`KL`]'s comment.
type Parts = [f32; 2];

impl Tape {
    fn forward(&mut self, w: &Weights, x: &[f32], eps: &[f32]) {
        let leaky = Activation::LeakyRelu(SLOPE);
        let layer = |y: &mut [Vec<f32>; 7], k: usize, from: Option<usize>| {
            let mut out = std::mem::take(&mut y[k]);
            dense(&w.layers[k], from.map_or(x, |i| &y[i]), &mut out);
            if matches!(k, FC1 | FC2 | D1 | D2) {
                leaky.apply(&mut out);
            }
            y[k] = out;
        };
        for (k, from) in [(FC1, None), (FC2, Some(FC1)), (MU, Some(FC2)), (SPREAD, Some(FC2))] {
            layer(&mut self.y, k, from);
        }
        self.z = self.y[MU].iter().zip(&self.y[SPREAD]).zip(eps).map(|((m, s), e)| m + softplus(*s) * e).collect();
        dense(&w.layers[D1], &self.z, &mut self.y[D1]);
        leaky.apply(&mut self.y[D1]);
        layer(&mut self.y, D2, Some(D1));
        layer(&mut self.y, OUT, Some(D2));
    }

    /// Adds the gradients of the mean loss over `all` rows.
    fn backward(&mut self, w: &Weights, g: &mut Weights, x: &[f32], eps: &[f32], truth: &[Mat3], all: usize) -> Parts {
        let share = 1.0 / all as f32;
        let (mut d, error) = rotation_loss(&self.y[OUT], truth, share);
        for (k, input) in [(OUT, &self.y[D2]), (D2, &self.y[D1]), (D1, &self.z)] {
            dense_grad(&mut g.layers[k], &d, input);
            let mut dx = vec![0.0; input.len()];
            dense_back(&w.layers[k], &d, &mut dx, false);
            if k != D1 {
                leaky_back(input, &mut dx);
            }
            d = dx;
        }
        let mut divergence = 0.0;
        let (mut d_mu, mut d_spread) = (d.clone(), d);
        for (i, (dm, ds)) in d_mu.iter_mut().zip(&mut d_spread).enumerate() {
            let (mu, raw) = (self.y[MU][i], self.y[SPREAD][i]);
            let sigma = softplus(raw);
            divergence += 0.5 * (mu * mu + sigma * sigma - 1.0) - sigma.ln();
            *dm += share * KL * mu;
            *ds = (*ds * eps[i] + share * KL * (sigma - 1.0 / sigma)) * sigmoid(raw);
        }
        let mut d2 = vec![0.0; self.y[FC2].len()];
        for (k, d) in [(MU, &d_mu), (SPREAD, &d_spread)] {
            dense_grad(&mut g.layers[k], d, &self.y[FC2]);
            dense_back(&w.layers[k], d, &mut d2, true);
        }
        leaky_back(&self.y[FC2], &mut d2);
        dense_grad(&mut g.layers[FC2], &d2, &self.y[FC1]);
        let mut d1 = vec![0.0; self.y[FC1].len()];
        dense_back(&w.layers[FC2], &d2, &mut d1, false);
        leaky_back(&self.y[FC1], &mut d1);
        dense_grad(&mut g.layers[FC1], &d1, x);
        [share * error, share * divergence]
    }
}

fn softplus(x: f32) -> f32 {
    // Never quite zero, for its logarithm is taken.
    (x.max(0.0) + (-x.abs()).exp().ln_1p()).max(1e-6)
}

fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}

/// Turns gradients with respect to a leaky ReLU's outputs `y` into gradients with respect to its inputs.
fn leaky_back(y: &[f32], d: &mut [f32]) {
    d.iter_mut().zip(y).filter(|(_, y)| **y < 0.0).for_each(|(d, _)| *d *= SLOPE);
}

/// Absolute error of the matrix entries, summed over a joint and averaged over joints; gradients scaled by `share`.
fn rotation_loss(out: &[f32], truth: &[Mat3], share: f32) -> (Vec<f32>, f32) {
    let joints = (POSE_DIM / 3) as f32;
    let (mut d, mut error) = (vec![0.0; out.len()], 0.0);
    for ((six, want), d) in out.chunks_exact(6).zip(truth).zip(d.chunks_exact_mut(6)) {
        let six: [f32; 6] = std::array::from_fn(|i| six[i]);
        let e = (from_6d(&six) - *want).transpose().to_cols_array();
        error += e.iter().map(|v| v.abs()).sum::<f32>() / joints;
        d.copy_from_slice(&back_6d(&six, &e.map(|v| share / joints * sign(v))));
    }
    (d, error)
}

/// The body pose of each frame of `set`.
fn poses(set: &MotionSet) -> Vec<&[f32]> {
    set.clips.iter().flat_map(|c| c.params.chunks_exact(PARAMS).map(|p| &p[POSE])).collect()
}

fn rotations(pose: &[f32]) -> impl Iterator<Item = Mat3> + '_ {
    pose.chunks_exact(3).map(|v| from_axis_angle(Vec3::from_slice(v)))
}

/// Trains a prior on the poses of `set` for `steps` updates; `tell` hears of each update's number, error and divergence.
/// Returns the file without a threshold: tensors under VPoser v1's names.
///
/// # Errors
/// If `set` holds no frame.
pub fn train(set: &MotionSet, steps: u64, seed: u64, mut tell: impl FnMut(u64, Parts)) -> Result<Vec<Named>> {
    let poses = poses(set);
    if poses.is_empty() {
        return Err(egogen::Error::invalid("no recorded frame to learn poses from"));
    }
    let normal = Normal::of(&poses);
    let rng = &mut stream(seed, "pose prior weights", 0);
    let sizes = [
        (POSE_DIM, WIDTH),
        (WIDTH, WIDTH),
        (WIDTH, POSE_LATENT),
        (WIDTH, POSE_LATENT),
        (POSE_LATENT, WIDTH),
        (WIDTH, WIDTH),
        (WIDTH, 2 * POSE_DIM),
    ];
    let mut w = Weights { layers: sizes.map(|(i, o)| fresh(rng, i, o)) };
    let mut adam = Adam::new(&w);
    let mut shards: Vec<(Tape, Weights)> = (0..ROWS / SHARD).map(|_| (Tape::default(), w.zeros())).collect();
    for step in 0..steps {
        let parts: Vec<Parts> = shards
            .par_iter_mut()
            .enumerate()
            .map(|(i, (tape, g))| {
                let rng = &mut stream(seed, "poses", step << 16 | i as u64);
                let chosen: Vec<&[f32]> = (0..SHARD).map(|_| poses[rng.random_range(0..poses.len())]).collect();
                let x: Vec<f32> = chosen.iter().flat_map(|p| normal.apply(p)).collect();
                let truth: Vec<Mat3> = chosen.iter().flat_map(|p| rotations(p)).collect();
                let eps = normals(rng, SHARD * POSE_LATENT);
                tape.forward(&w, &x, &eps);
                tape.backward(&w, g, &x, &eps, &truth, ROWS)
            })
            .collect();
        let (first, rest) = shards.split_at_mut(1);
        rest.iter_mut().for_each(|(_, g)| merge(&mut first[0].1, g));
        let done = step as f32 / steps as f32;
        adam.update(&mut w, &mut first[0].1, RATES[0] + (RATES[1] - RATES[0]) * done);
        tell(step + 1, parts.iter().fold([0.0; 2], |a, p| [a[0] + p[0], a[1] + p[1]]));
    }
    Ok(named(&w, &normal))
}

impl Normal {
    fn of(poses: &[&[f32]]) -> Self {
        let n = poses.len() as f64;
        let mean: Vec<f64> = (0..POSE_DIM).map(|k| poses.iter().map(|p| f64::from(p[k])).sum::<f64>() / n).collect();
        let var = |k: usize| poses.iter().map(|p| (f64::from(p[k]) - mean[k]).powi(2)).sum::<f64>() / n;
        // Joints that hardly move in the recordings must not blow up what little they do.
        Self { var: (0..POSE_DIM).map(|k| (var(k) as f32).max(1e-3)).collect(), mean: mean.iter().map(|&m| m as f32).collect() }
    }

    fn apply<'a>(&'a self, pose: &'a [f32]) -> impl Iterator<Item = f32> + 'a {
        pose.iter().zip(&self.mean).zip(&self.var).map(|((x, m), v)| (x - m) / v.sqrt())
    }
}

fn named(w: &Weights, normal: &Normal) -> Vec<Named> {
    let mut out: Vec<Named> = Vec::new();
    for (d, name) in w.layers.iter().zip(NAMES) {
        out.push((format!("bodyprior_{name}.weight"), vec![d.output, d.input], d.weight.clone()));
        out.push((format!("bodyprior_{name}.bias"), vec![d.output], d.bias.clone()));
    }
    // Ours has no second normalisation; the reader adds torch's 1e-5 to each variance.
    let one = |n: usize| (vec![0.0; n], vec![1.0 - 1e-5; n]);
    for (name, (mean, var)) in [("bn1", (normal.mean.clone(), normal.var.clone())), ("bn2", one(WIDTH))] {
        let n = mean.len();
        for (part, data) in [("weight", vec![1.0; n]), ("bias", vec![0.0; n]), ("running_mean", mean), ("running_var", var)] {
            out.push((format!("bodyprior_enc_{name}.{part}"), vec![n], data));
        }
    }
    out
}

/// The file of a prior with its threshold, half precision.
pub fn pack(tensors: &[Named], threshold: f32) -> Result<Vec<u8>> {
    pack_tensors(tensors, &BTreeMap::from([(THRESHOLD.to_string(), threshold.to_string())]), Precision::Half)
}

/// How a prior tells natural from distorted poses.
#[derive(Clone, Debug, Serialize)]
pub struct PoseReport {
    /// Held-out frames.
    pub poses: usize,
    /// Mean angle between recorded joints and those decoded from the mean of the embedding, degrees.
    pub error_deg: f32,
    /// ||VP|| of held-out poses: 5, 50, 95 %.
    pub natural: [f32; 3],
    /// ||VP|| of the same poses distorted, see [`DISTORTION`].
    pub distorted: [f32; 3],
    /// Norm with as large a share of natural poses above as of distorted ones below.
    pub threshold: f32,
    /// That share.
    pub overlap: f32,
}

/// Judges `prior` on the frames of `held_out`.
pub fn judge(prior: &PosePrior, held_out: &MotionSet) -> PoseReport {
    let natural: Vec<f32> = poses(held_out).concat();
    let mut rng = stream(0, "distorted poses", 0);
    let distorted: Vec<f32> = natural.chunks_exact(3).flat_map(|v| distort(v, &mut rng)).collect();
    let mu = prior.encode(&natural);
    let norms = |mu: &[f32]| -> Vec<f32> {
        let mut all: Vec<f32> = mu.chunks_exact(POSE_LATENT).map(|m| m.iter().map(|v| v * v).sum::<f32>().sqrt()).collect();
        all.sort_by(f32::total_cmp);
        all
    };
    let (a, b) = (norms(&mu), norms(&prior.encode(&distorted)));
    let (threshold, overlap) = equal_error(&a, &b);
    let decoded = prior.decode(&mu);
    let angles: Vec<f32> = decoded
        .chunks_exact(6)
        .zip(natural.chunks_exact(3))
        .map(|(six, v)| {
            let six: [f32; 6] = std::array::from_fn(|i| six[i]);
            to_axis_angle(&(from_6d(&six).transpose() * from_axis_angle(Vec3::from_slice(v)))).length().to_degrees()
        })
        .collect();
    let three = |v: &[f32]| [0.05, 0.5, 0.95].map(|q| v[((v.len() - 1) as f32 * q) as usize]);
    PoseReport {
        poses: a.len(),
        error_deg: angles.iter().sum::<f32>() / angles.len() as f32,
        natural: three(&a),
        distorted: three(&b),
        threshold,
        overlap,
    }
}

fn distort(v: &[f32], rng: &mut Stream) -> [f32; 3] {
    let [x, y, z, angle]: [f32; 4] = std::array::from_fn(|_| normals(rng, 1)[0]);
    let turn = Vec3::new(x, y, z).normalize_or_zero() * (DISTORTION * angle);
    to_axis_angle(&(from_axis_angle(Vec3::from_slice(v)) * from_axis_angle(turn))).to_array()
}

/// The value with as large a share of `low` above it as of `high` below it, and that share; both ascending.
fn equal_error(low: &[f32], high: &[f32]) -> (f32, f32) {
    let above = |t: f32| 1.0 - low.partition_point(|&v| v < t) as f32 / low.len() as f32;
    let below = |t: f32| high.partition_point(|&v| v < t) as f32 / high.len() as f32;
    let t = low.iter().chain(high).copied().min_by(|&a, &b| (above(a) - below(a)).abs().total_cmp(&(above(b) - below(b)).abs()));
    let t = t.unwrap_or(0.0);
    (t, above(t).max(below(t)))
}

const _: () = assert!(POSE_DIM == 3 * (BODY_JOINTS - 1));

#[cfg(test)]
mod tests {
    use super::*;
    use egogen::io::Tensors;

    #[test]
    fn gradients_match_differences() {
        let rng = &mut stream(1, "pose test", 0);
        let sizes = [(POSE_DIM, 6), (6, 6), (6, POSE_LATENT), (6, POSE_LATENT), (POSE_LATENT, 6), (6, 6), (6, 2 * POSE_DIM)];
        let w = Weights { layers: sizes.map(|(i, o)| fresh(rng, i, o)) };
        let rows = 3;
        let (x, eps) = (normals(rng, rows * POSE_DIM), normals(rng, rows * POSE_LATENT));
        let truth: Vec<Mat3> = normals(rng, rows * POSE_DIM).chunks_exact(3).map(|v| from_axis_angle(Vec3::from_slice(v))).collect();
        let loss = |w: &Weights| {
            let mut tape = Tape::default();
            tape.forward(w, &x, &eps);
            let [error, divergence] = tape.backward(w, &mut w.zeros(), &x, &eps, &truth, rows);
            f64::from(error) + f64::from(KL) * f64::from(divergence)
        };
        let (mut g, mut tape) = (w.zeros(), Tape::default());
        tape.forward(&w, &x, &eps);
        tape.backward(&w, &mut g, &x, &eps, &truth, rows);
        for (k, name) in NAMES.iter().enumerate() {
            let gradient = g.layers[k].weight.clone();
            let norm = gradient.iter().map(|v| v * v).sum::<f32>().sqrt();
            let random = normals(rng, gradient.len());
            let length = random.iter().map(|v| v * v).sum::<f32>().sqrt();
            for direction in [gradient.iter().map(|v| v / norm).collect::<Vec<_>>(), random.iter().map(|v| v / length).collect()] {
                let moved = |h: f32| {
                    let mut w = w.clone();
                    w.layers[k].weight.iter_mut().zip(&direction).for_each(|(w, d)| *w += h * d);
                    loss(&w)
                };
                let want = (moved(3e-3) - moved(-3e-3)) / 6e-3;
                let got: f32 = gradient.iter().zip(&direction).map(|(g, d)| g * d).sum();
                assert!((f64::from(got) - want).abs() < 0.02 * f64::from(norm) + 1e-4, "{name}: {got} {want} of {norm}");
            }
        }
    }

    #[test]
    fn a_prior_learns_to_tell_poses_apart() {
        // Poses on a line: every joint bends by the same angle.
        let clip = |angles: &[f32]| {
            let params = angles.iter().flat_map(|a| (0..PARAMS).map(move |k| if POSE.contains(&k) && k % 3 == 0 { *a } else { 0.0 }));
            egogen::motion::ClipMarkers { name: String::new(), markers: vec![], params: params.collect(), joints: vec![] }
        };
        let angles: Vec<f32> = (0..200).map(|i| 0.4 * (i as f32 / 10.0).sin()).collect();
        let set = MotionSet { clips: vec![clip(&angles)] };
        let mut errors = vec![];
        let tensors = train(&set, 120, 0, |_, p| errors.push(p[0])).unwrap();
        assert!(errors[119] < 0.5 * errors[0], "{} {}", errors[0], errors[119]);
        let bytes = pack(&tensors, 3.5).unwrap();
        let prior = PosePrior::from_tensors(&Tensors::from_bytes("made", bytes).unwrap()).unwrap();
        assert_eq!(prior.threshold(), 3.5);
        let report = judge(&prior, &set);
        assert!(report.distorted[1] > 1.3 * report.natural[1] && report.overlap < 0.35, "{report:?}");
        assert!(train(&MotionSet::default(), 1, 0, |_, _| ()).is_err());
    }

    #[test]
    fn equal_error_by_hand() {
        // One of five above 4.5, one of five below it.
        let (t, share) = equal_error(&[1.0, 2.0, 3.0, 4.0, 9.0], &[4.0, 5.0, 6.0, 7.0, 8.0]);
        assert!((4.0..=5.0).contains(&t) && (share - 0.2).abs() < 1e-6, "{t} {share}");
    }
}
