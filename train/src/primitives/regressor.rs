//! Forward and backward pass of the body regressor and its loss.

use super::layers::{add_rows, dense, dense_back, dense_grad, dense_into};
use super::loss::sign;
use egogen::body::rotation::from_6d;
use egogen::body::{BETAS, BODY_JOINTS, MARKER_DIM, ShapedBody};
use egogen::kernels::{Mat, product};
use egogen::motion::{CONTINUOUS, RegressorSizes, RegressorWeights};
use glam::{Mat3, Vec3};

const INPUT: usize = RegressorSizes::INPUT;
const ESTIMATE: usize = MARKER_DIM + BETAS;

/// What one pass over the network keeps.
#[derive(Default)]
struct Pass {
    input: Vec<f32>,
    /// Before the first block, then after each.
    h: Vec<Vec<f32>>,
    /// After the first and (before the residual sum) the second layer of each block.
    inner: Vec<[Vec<f32>; 2]>,
}

/// Everything one forward pass leaves behind.
#[derive(Default)]
pub struct Tape {
    passes: Vec<Pass>,
    /// rows x 159: the bodies.
    pub body: Vec<f32>,
}

fn relu(values: &mut [f32]) {
    values.iter_mut().for_each(|v| *v = v.max(0.0));
}

fn relu_back(y: &[f32], d: &mut [f32]) {
    d.iter_mut().zip(y).for_each(|(d, y)| *d = if *y > 0.0 { *d } else { 0.0 });
}

impl Tape {
    /// Bodies of `markers` (rows x 201) and `betas` (rows x 10) into `body`.
    pub fn forward(&mut self, w: &RegressorWeights, markers: &[f32], betas: &[f32]) {
        let rows = markers.len() / MARKER_DIM;
        self.body.clear();
        self.body.resize(rows * CONTINUOUS, 0.0);
        self.passes.resize_with(w.passes, Pass::default);
        for pass in &mut self.passes {
            pass.input.clear();
            for i in 0..rows {
                pass.input.extend_from_slice(&markers[i * MARKER_DIM..(i + 1) * MARKER_DIM]);
                pass.input.extend_from_slice(&betas[i * BETAS..(i + 1) * BETAS]);
                pass.input.extend_from_slice(&self.body[i * CONTINUOUS..(i + 1) * CONTINUOUS]);
            }
            pass.forward(w);
            let mut change = vec![0.0; rows * CONTINUOUS];
            dense_into(&w.out_fc, &pass.h[w.blocks.len()], &mut change);
            add_rows(&change, &mut self.body);
        }
    }

    /// Adds the weight gradients; `d` (rows x 159) is the loss's gradient with respect to the bodies.
    pub fn backward(&mut self, w: &RegressorWeights, g: &mut RegressorWeights, mut d: Vec<f32>) {
        let rows = d.len() / CONTINUOUS;
        let width = w.in_fc.output;
        let from_estimate = Mat::strided(&w.in_fc.weight[ESTIMATE..], width, CONTINUOUS, INPUT);
        for pass in self.passes.iter().rev() {
            dense_grad(&mut g.out_fc, &d, &pass.h[w.blocks.len()]);
            let mut dh = vec![0.0; rows * width];
            dense_back(&w.out_fc, &d, &mut dh, false);
            for (k, (block, grad)) in w.blocks.iter().zip(&mut g.blocks).enumerate().rev() {
                let [first, second] = &pass.inner[k];
                let mut d2 = dh.clone();
                relu_back(second, &mut d2);
                dense_grad(&mut grad[1], &d2, first);
                let mut d1 = vec![0.0; rows * width];
                dense_back(&block[1], &d2, &mut d1, false);
                relu_back(first, &mut d1);
                dense_grad(&mut grad[0], &d1, &pass.h[k]);
                dense_back(&block[0], &d1, &mut dh, true);
            }
            dense_grad(&mut g.in_fc, &dh, &pass.input);
            product(Mat::new(&dh, rows, width), from_estimate, &mut d, CONTINUOUS, true);
        }
    }
}

impl Pass {
    fn forward(&mut self, w: &RegressorWeights) {
        self.h.resize_with(w.blocks.len() + 1, Vec::new);
        self.inner.resize_with(w.blocks.len(), Default::default);
        dense(&w.in_fc, &self.input, &mut self.h[0]);
        for (k, [a, b]) in w.blocks.iter().enumerate() {
            let [first, second] = &mut self.inner[k];
            dense(a, &self.h[k], first);
            relu(first);
            dense(b, first, second);
            relu(second);
            let sum: Vec<f32> = self.h[k].iter().zip(second.iter()).map(|(h, s)| h + s).collect();
            self.h[k + 1] = sum;
        }
    }
}

/// What a body should be.
#[derive(Clone, Debug)]
pub struct Truth {
    /// Markers, 201.
    pub markers: Vec<f32>,
    /// Local rotations and translation, where they are known.
    pub pose: Option<([Mat3; BODY_JOINTS], Vec3)>,
}

/// Weight of the mean absolute rotation-matrix error, in metres per unit.
const ROTATION: f32 = 0.1;
/// Weight of the mean absolute translation error.
const TRANSLATION: f32 = 0.3;
/// Weight of the mean squared hand parameter (A3).
const HANDS: f32 = 0.01;

/// Loss of one body and its gradient with respect to the continuous form `c` (159), scaled by `share`, into `d`.
/// Returns (loss, mean distance of markers in metres).
pub fn body_loss(body: &ShapedBody, c: &[f32], truth: &Truth, share: f32, d: &mut [f32]) -> (f32, f32) {
    let six: [[f32; 6]; BODY_JOINTS] = std::array::from_fn(|k| std::array::from_fn(|i| c[3 + 6 * k + i]));
    let local = six.each_ref().map(from_6d);
    let transl = Vec3::from_slice(c);
    let posed = body.pose_rotations(&local, transl);
    let mut markers = [0.0; MARKER_DIM];
    body.markers(&posed, &mut markers);
    let mut grad = [0.0; MARKER_DIM];
    let (mut loss, mut distance) = (0.0, 0.0);
    for (i, g) in grad.iter_mut().enumerate() {
        let e = markers[i] - truth.markers[i];
        loss += e.abs() / MARKER_DIM as f32;
        *g = sign(e) / MARKER_DIM as f32;
    }
    for (a, b) in markers.chunks_exact(3).zip(truth.markers.chunks_exact(3)) {
        distance += Vec3::from_slice(a).distance(Vec3::from_slice(b));
    }
    let (mut d_transl, mut d_local) = body.markers_backward(&posed, &local, &grad);
    if let Some((rotations, position)) = &truth.pose {
        loss += pose_loss(&local, transl, rotations, *position, &mut d_transl, &mut d_local);
    }
    for (o, g) in d.iter_mut().zip(d_transl) {
        *o = share * g;
    }
    for ((six, g), d) in six.iter().zip(&d_local).zip(d[3..].chunks_exact_mut(6)) {
        d.iter_mut().zip(back_6d(six, g)).for_each(|(o, g)| *o = share * g);
    }
    let hands = 3 + 6 * BODY_JOINTS;
    for (o, v) in d[hands..].iter_mut().zip(&c[hands..]) {
        loss += HANDS * v * v / 24.0;
        *o = share * HANDS * 2.0 * v / 24.0;
    }
    (loss, distance * 3.0 / MARKER_DIM as f32)
}

fn pose_loss(
    local: &[Mat3; BODY_JOINTS],
    transl: Vec3,
    rotations: &[Mat3; BODY_JOINTS],
    position: Vec3,
    d_transl: &mut [f32; 3],
    d_local: &mut [[f32; 9]; BODY_JOINTS],
) -> f32 {
    let mut loss = 0.0;
    let scale = TRANSLATION / 3.0;
    for (g, e) in d_transl.iter_mut().zip((transl - position).to_array()) {
        loss += scale * e.abs();
        *g += scale * sign(e);
    }
    let scale = ROTATION / (9 * BODY_JOINTS) as f32;
    for ((a, b), g) in local.iter().zip(rotations).zip(d_local) {
        for (e, g) in (*a - *b).transpose().to_cols_array().into_iter().zip(g) {
            loss += scale * e.abs();
            *g += scale * sign(e);
        }
    }
    loss
}

/// Gradient with respect to the 6-D form from that with respect to the rotation matrix (row-major), through Gram-Schmidt.
pub fn back_6d(six: &[f32; 6], g: &[f32; 9]) -> [f32; 6] {
    let (c, a) = (Vec3::new(six[0], six[2], six[4]), Vec3::new(six[1], six[3], six[5]));
    let [mut gx, mut gy, gz] = [0, 1, 2].map(|k| Vec3::new(g[k], g[3 + k], g[6 + k]));
    let x = c.normalize_or_zero();
    let s = x.dot(a);
    let u = a - x * s;
    let y = u.normalize_or_zero();
    gx += y.cross(gz);
    gy += gz.cross(x);
    let du = (gy - y * y.dot(gy)) / u.length().max(1e-6);
    let da = du - x * x.dot(du);
    gx -= du * s + a * x.dot(du);
    let dc = (gx - x * x.dot(gx)) / c.length().max(1e-6);
    [dc.x, da.x, dc.y, da.y, dc.z, da.z]
}

#[cfg(test)]
mod tests {
    use super::super::init;
    use super::*;
    use burn::tensor::{Device, Tensor, TensorData};
    use egogen::motion::{Parameters, Regressor};
    use egogen::rng::stream;
    use rand::RngExt;

    fn draw(n: usize, index: u64) -> Vec<f32> {
        let rng = &mut stream(7, "regressor test", index);
        (0..n).map(|_| rng.random_range(-1.0..1.0)).collect()
    }

    #[test]
    fn gradients_match_burn() {
        let sizes = RegressorSizes { width: 12, blocks: 2, passes: 3 };
        let w = init::regressor(sizes, 1, &[0.0; MARKER_DIM], &[0.1; CONTINUOUS]);
        let rows = 5;
        let (markers, betas, d) = (draw(rows * MARKER_DIM, 0), draw(rows * BETAS, 1), draw(rows * CONTINUOUS, 2));
        let device = Device::flex().autodiff();
        let tensor = |v: &[f32]| Tensor::<2>::from_data(TensorData::new(v.to_vec(), [rows, v.len() / rows]), &device);
        let net = Regressor::new(&w, &device);
        let out = net.forward(tensor(&markers), tensor(&betas));
        let mut grads = (out.clone() * tensor(&d)).sum().backward();
        let (mut want, mut g) = (w.zeros(), w.zeros());
        net.add_gradients(&mut grads, &mut want);
        let mut tape = Tape::default();
        tape.forward(&w, &markers, &betas);
        let out = out.into_data();
        assert!(tape.body.iter().zip(out.as_slice::<f32>().unwrap()).all(|(a, b)| (a - b).abs() < 1e-5));
        tape.backward(&w, &mut g, d);
        for ((name, _, _), (a, b)) in w.named().iter().zip(g.tensors_mut().into_iter().zip(want.tensors_mut())) {
            let scale = b.iter().fold(0.0f32, |m, v| m.max(v.abs()));
            let worst = a.iter().zip(b.iter()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(scale > 0.0 && worst < 1e-4 * scale, "{name}: {worst} of {scale}");
        }
    }

    #[test]
    fn six_numbers_match_differences() {
        let six: [f32; 6] = [0.9, 0.2, -0.3, 1.1, 0.4, -0.5];
        let g: [f32; 9] = [0.3, -0.2, 0.5, 0.7, 0.1, -0.4, 0.2, 0.6, -0.8];
        let f =
            |s: &[f32; 6]| -> f64 { from_6d(s).transpose().to_cols_array().iter().zip(&g).map(|(a, b)| (*a as f64) * (*b as f64)).sum() };
        let got = back_6d(&six, &g);
        for i in 0..6 {
            let (mut up, mut down) = (six, six);
            up[i] += 1e-3;
            down[i] -= 1e-3;
            let want = (f(&up) - f(&down)) / 2e-3;
            assert!((got[i] as f64 - want).abs() < 1e-3, "{i}: {} {want}", got[i]);
        }
    }
}
