//! Adam over the tensors of a network.

use egogen::motion::Parameters;
use rayon::prelude::*;

/// Moments of all parameters.
#[derive(Clone)]
pub struct Adam<P> {
    /// First moment.
    pub m: P,
    /// Second moment.
    pub v: P,
    /// Updates made.
    pub steps: u64,
}

const BETAS: [f32; 2] = [0.9, 0.999];
const EPS: f32 = 1e-8;

impl<P: Parameters> Adam<P> {
    pub fn new(weights: &P) -> Self {
        Self { m: weights.zeros(), v: weights.zeros(), steps: 0 }
    }

    /// One update with learning rate `lr`; clears `grad`.
    pub fn update(&mut self, weights: &mut P, grad: &mut P, lr: f32) {
        self.steps += 1;
        let t = self.steps as i32;
        let scale = lr / (1.0 - BETAS[0].powi(t));
        let root = (1.0 - BETAS[1].powi(t)).sqrt().recip();
        let mut all: Vec<_> =
            weights.tensors_mut().into_iter().zip(grad.tensors_mut()).zip(self.m.tensors_mut()).zip(self.v.tensors_mut()).collect();
        all.par_iter_mut().for_each(|(((w, g), m), v)| {
            for (((w, g), m), v) in w.iter_mut().zip(g.iter_mut()).zip(m.iter_mut()).zip(v.iter_mut()) {
                *m += (1.0 - BETAS[0]) * (*g - *m);
                *v += (1.0 - BETAS[1]) * (*g * *g - *v);
                *w -= scale * *m / (v.sqrt() * root + EPS);
                *g = 0.0;
            }
        });
    }
}

/// Adds gradients `from` to `to` and clears `from`.
pub fn merge<P: Parameters>(to: &mut P, from: &mut P) {
    for (a, b) in to.tensors_mut().into_iter().zip(from.tensors_mut()) {
        a.iter_mut().zip(b.iter_mut()).for_each(|(a, b)| *a += std::mem::take(b));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Clone)]
    struct One(Vec<f32>);

    impl Parameters for One {
        fn tensors_mut(&mut self) -> Vec<&mut Vec<f32>> {
            vec![&mut self.0]
        }
    }

    #[test]
    fn two_updates_by_hand() {
        // g = 1 then 3: m = .1 then .39, corrected 1 then .39/.19; v = .001 then .009999, corrected 1 then .009999/.001999.
        let (mut w, mut g) = (One(vec![0.5]), One(vec![1.0]));
        let mut adam = Adam::new(&w);
        adam.update(&mut w, &mut g, 0.1);
        assert!((w.0[0] - 0.4).abs() < 1e-6 && g.0[0] == 0.0);
        g.0[0] = 3.0;
        adam.update(&mut w, &mut g, 0.1);
        let want = 0.4 - 0.1 * (0.39 / 0.19) / (0.009999f32 / 0.001999).sqrt();
        assert!((w.0[0] - want).abs() < 1e-5, "{} {want}", w.0[0]);
    }
}
