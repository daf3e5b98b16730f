//! Seed motions: the two frames a person starts from.

use crate::body::{BETAS, BodyModel, PARAMS};
use crate::io::{Precision, Tensors, pack_tensors, write_atomic};
use crate::motion::SEED;
use crate::{Error, Result};
use std::path::Path;

/// Two frames of body parameters, 1/40 s apart, and the shape of the body.
#[derive(Clone, Debug, PartialEq)]
pub struct SeedMotion {
    /// 2 x 93, in the canonical frame of the first.
    pub params: Vec<f32>,
    /// Shape coefficients.
    pub betas: [f32; BETAS],
}

impl SeedMotion {
    pub(super) fn check(&self) -> Result<()> {
        if self.params.len() != SEED * PARAMS {
            return Err(Error::invalid(format!("a seed motion of {} floats, expected {SEED} x {PARAMS}", self.params.len())));
        }
        match self.params.iter().chain(&self.betas).position(|v| !v.is_finite()) {
            Some(i) => Err(Error::invalid(format!("a seed motion that is not finite at entry {i}"))),
            None => Ok(()),
        }
    }
}

/// Seed motions to choose from.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SeedBank {
    /// At least one.
    pub seeds: Vec<SeedMotion>,
}

impl SeedBank {
    /// The first half, to train from, and the second, to test from.
    pub fn halves(mut self) -> (Self, Self) {
        let second = self.seeds.split_off(self.seeds.len() / 2);
        (self, Self { seeds: second })
    }

    /// Reads the bank at `path`: `params` (S, 2, 93) and `betas` (S, 10). Refuses one made with another body than `body`.
    pub fn read(path: impl AsRef<Path>, body: &BodyModel) -> Result<Self> {
        Self::from_tensors(&Tensors::read(path)?, body)
    }

    /// Like [`SeedBank::read`] for the content of a file; `origin` names it in errors.
    pub fn from_bytes(origin: impl AsRef<Path>, bytes: &[u8], body: &BodyModel) -> Result<Self> {
        Self::from_tensors(&Tensors::from_bytes(origin, bytes.to_vec())?, body)
    }

    fn from_tensors(t: &Tensors, body: &BodyModel) -> Result<Self> {
        let info = t.metadata();
        let made_with = info.get("body").map_or("", String::as_str);
        if made_with != body.hash() {
            let what = format!("was made with the body '{made_with}', but this body is '{}'; make the seeds again", body.hash());
            return Err(Error::file(t.origin(), what));
        }
        let params = t.f32s("params", &[0, SEED, PARAMS])?;
        let count = params.len() / (SEED * PARAMS);
        let betas = t.f32s("betas", &[count, BETAS])?;
        if count == 0 {
            return Err(Error::file(t.origin(), "tensor 'params' holds no seed motion, expected at least one"));
        }
        let each = params.chunks_exact(SEED * PARAMS).zip(betas.as_chunks().0);
        Ok(Self { seeds: each.map(|(p, b)| SeedMotion { params: p.to_vec(), betas: *b }).collect() })
    }

    /// Writes the bank to `path`, naming the body it was made with.
    pub fn write(&self, path: impl AsRef<Path>, body: &BodyModel) -> Result<()> {
        self.seeds.iter().try_for_each(SeedMotion::check)?;
        let s = self.seeds.len();
        let params = self.seeds.iter().flat_map(|s| s.params.iter().copied()).collect();
        let betas = self.seeds.iter().flat_map(|s| s.betas).collect();
        let tensors = [("params".into(), vec![s, SEED, PARAMS], params), ("betas".into(), vec![s, BETAS], betas)];
        let info = [("body".to_string(), body.hash().to_string())].into_iter().collect();
        write_atomic(path, &pack_tensors(&tensors, &info, Precision::Full)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::tests::{random_params, toy};

    #[test]
    fn a_bank_survives_its_file_and_names_its_body() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("seeds.safetensors");
        let seed = |i| SeedMotion { params: [random_params(i), random_params(i + 1)].concat(), betas: [0.1 * i as f32; BETAS] };
        let bank = SeedBank { seeds: (0..3).map(seed).collect() };
        bank.write(&path, &toy()).unwrap();
        assert_eq!(SeedBank::read(&path, &toy()).unwrap(), bank);

        let error = SeedBank::read(&path, &BodyModel::embedded()).unwrap_err().to_string();
        assert!(error.contains("seeds.safetensors") && error.contains("'toy'"), "{error}");

        SeedBank::default().write(&path, &toy()).unwrap();
        assert!(SeedBank::read(&path, &toy()).unwrap_err().to_string().contains("no seed motion"));
    }
}
