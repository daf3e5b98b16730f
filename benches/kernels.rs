//! Inference kernels at the paper's sizes, beside the matrix-product ceiling and burn's modules in the same run.
//!
//! Cases take turns and the best of several rounds counts, so that the ratios hold on a busy machine.

use egogen::agent::{Network, ObsGroup, ObsLayout, PolicyConfig, PolicySpec};
use egogen::body::{BETAS, MARKER_DIM, PARAMS};
use egogen::kernels::{Decoder, Mat, PolicyEngine, Regressor, product};
use egogen::motion::{CONTINUOUS, Dense, FUTURE, Gru, PredictorSizes, PredictorWeights, RegressorSizes, RegressorWeights, SEED};
use rand::RngExt;
use std::hint::black_box;
use std::time::Instant;

const PEOPLE: usize = 256;
const BODIES: usize = 5120;
const ROUNDS: usize = 15;

/// Something to time: name, floating-point operations, one run.
type Case<'a> = (&'a str, f64, Box<dyn FnMut() + 'a>);

fn noise(n: usize, size: f32) -> Vec<f32> {
    let mut rng = egogen::rng::stream(1, "bench", n as u64);
    (0..n).map(|_| rng.random_range(-size..size)).collect()
}

fn dense(input: usize, output: usize) -> Dense {
    Dense { input, output, weight: noise(input * output, 0.05), bias: noise(output, 0.05) }
}

fn gru(input: usize, hidden: usize) -> Gru {
    let (weight_ih, weight_hh) = (noise(3 * hidden * input, 0.05), noise(3 * hidden * hidden, 0.05));
    Gru { input, hidden, weight_ih, weight_hh, bias_ih: noise(3 * hidden, 0.05), bias_hh: noise(3 * hidden, 0.05) }
}

fn predictor() -> PredictorWeights {
    let s = PredictorSizes::default();
    PredictorWeights {
        x_enc: gru(s.frame, s.hidden),
        e_mu: dense(s.hidden, s.latent),
        drnn_mlp: [dense(s.hidden, s.wide), dense(s.wide, s.hidden), dense(s.hidden, s.hidden)],
        d_rnn: gru(s.hidden + s.latent + s.frame, s.hidden),
        d_mlp: [dense(s.hidden, s.wide), dense(s.wide, s.hidden)],
        d_out: dense(s.hidden, s.frame),
        ..PredictorWeights::default()
    }
}

fn regressor() -> RegressorWeights {
    let s = RegressorSizes::default();
    RegressorWeights {
        passes: s.passes,
        in_fc: dense(RegressorSizes::INPUT, s.width),
        blocks: (0..s.blocks).map(|_| [dense(s.width, s.width), dense(s.width, s.width)]).collect(),
        out_fc: dense(s.width, CONTINUOUS),
    }
}

/// The paper's policy: state (2, 402) and sensing (2, 32) through GRUs of 512, two scalars of 32 octaves.
fn policy() -> PolicySpec {
    let group = |name: &str, shape: &[usize]| ObsGroup { name: name.into(), shape: shape.into() };
    let groups = vec![group("state", &[2, 402]), group("egosensing", &[2, 32]), group("dist", &[1]), group("time", &[1])];
    let config: PolicyConfig =
        serde_json::from_value(serde_json::json!({"gru": {"state": 512, "egosensing": 512}, "octaves": 32})).expect("a valid policy");
    PolicySpec::new(config, ObsLayout::new(groups), 128).expect("a valid policy")
}

/// A square product on all threads: what the processor can do.
fn ceiling<'a>() -> Case<'a> {
    const N: usize = 1024;
    let (a, b, mut c) = (noise(N * N, 1.0), noise(N * N, 1.0), vec![0.0f32; N * N]);
    let run = move || {
        let (n, threads) = (N as isize, gemm::Parallelism::Rayon(0));
        // SAFETY: all three are N x N floats, row-major.
        unsafe {
            gemm::gemm(N, N, N, c.as_mut_ptr(), 1, n, false, a.as_ptr(), 1, n, b.as_ptr(), 1, n, 0.0, 1.0, false, false, false, threads);
        }
        black_box(&c);
    };
    ("gemm 1024^3", 2.0 * (N * N * N) as f64, Box::new(run))
}

/// x W^T for 128 people on one thread as learning takes it, with weights of 12 layers that come from memory: here, and by the library.
fn fresh_weights<'a>() -> [Case<'a>; 2] {
    const ROWS: usize = 128;
    const SIZE: usize = 1152;
    let flop = 2.0 * (12 * ROWS * SIZE * SIZE) as f64;
    let make = || (noise(ROWS * SIZE, 1.0), (0..12).map(|_| noise(SIZE * SIZE, 1.0)).collect::<Vec<_>>(), vec![0.0f32; ROWS * SIZE]);
    let (x, layers, mut y) = make();
    let own = move || {
        layers.iter().for_each(|w| product(Mat::new(&x, ROWS, SIZE), Mat::new(w, SIZE, SIZE).t(), &mut y, SIZE, false));
        black_box(&y);
    };
    let (x, layers, mut y) = make();
    let library = move || {
        let (n, threads) = (SIZE as isize, gemm::Parallelism::None);
        for w in &layers {
            // SAFETY: x and y are ROWS x SIZE floats, w SIZE x SIZE, which is read transposed.
            unsafe {
                let (y, x, w) = (y.as_mut_ptr(), x.as_ptr(), w.as_ptr());
                gemm::gemm(ROWS, SIZE, SIZE, y, 1, n, false, x, 1, n, w, n, 1, 0.0, 1.0, false, false, false, threads);
            }
        }
        black_box(&y);
    };
    [("x W^T, one thread", flop, Box::new(own)), ("the same by gemm", flop, Box::new(library))]
}

fn main() {
    let (decoder, regressor) = (Decoder::new(&predictor()).expect("shapes"), Regressor::new(&regressor()).expect("shapes"));
    let (seed, latent) = (noise(PEOPLE * SEED * MARKER_DIM, 1.0), noise(PEOPLE * decoder.latent_dim(), 1.0));
    let (markers, betas) = (noise(BODIES * MARKER_DIM, 1.0), noise(BODIES * BETAS, 1.0));
    let (mut frames, mut params) = (vec![0.0; PEOPLE * FUTURE * MARKER_DIM], vec![0.0; BODIES * PARAMS]);
    let spec = policy();
    let flat = noise(spec.params(), 0.03);
    let engine = PolicyEngine::new(&spec, &flat).expect("shapes");
    let device = burn::tensor::Device::flex();
    let network = Network::new(&spec, &flat, &device);
    let obs = noise(PEOPLE * spec.layout.dim(), 1.0);
    let mut out = vec![0.0; PEOPLE * engine.output_dim()];
    let policy_flop = {
        let head: usize = spec.actor.iter().chain(&spec.critic).map(|&l| spec.layers[l].input * spec.layers[l].output).sum();
        let all: usize = spec.layers.iter().map(|d| d.input * d.output).sum();
        2.0 * (PEOPLE * (2 * all - head)) as f64
    };
    let mut cases: Vec<Case> = vec![
        ceiling(),
        ("decoder, 256 people", 9.4e9, Box::new(|| decoder.decode(&seed, &latent, &mut frames).expect("lengths"))),
        ("regressor, 5,120 bodies", 12.1e9, Box::new(|| regressor.regress(&markers, &betas, &mut params).expect("lengths"))),
        ("policy, 256 people", policy_flop, Box::new(|| engine.forward(&obs, &mut out).expect("lengths"))),
        ("policy in burn", policy_flop, Box::new(|| drop(black_box(network.forward(&obs).mu.into_data())))),
        ("packing the policy", 0.0, Box::new(|| drop(black_box(PolicyEngine::new(&spec, &flat))))),
    ];
    cases.extend(fresh_weights());
    let mut best = vec![f64::INFINITY; cases.len()];
    for _ in 0..ROUNDS {
        for ((_, _, run), best) in cases.iter_mut().zip(&mut best) {
            let start = Instant::now();
            run();
            *best = best.min(start.elapsed().as_secs_f64());
        }
    }
    let peak = cases[0].1 / best[0];
    println!("{} threads; GFLOP/s count the operations of the plain networks", rayon::current_num_threads());
    println!("{:<26}{:>9}{:>10}{:>10}", "", "ms", "GFLOP/s", "of gemm");
    for ((name, flop, _), best) in cases.iter().zip(best) {
        println!("{name:<26}{:>9.1}{:>10.0}{:>9.0}%", best * 1e3, flop / best * 1e-9, 100.0 * flop / best / peak);
    }
}
