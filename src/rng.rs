//! Named, serialisable random streams. There is no global generator anywhere in the project.

use rand::SeedableRng;
use sha2::{Digest, Sha256};

/// The generator behind every random draw; its state can be saved with serde.
pub type Stream = rand_chacha::ChaCha8Rng;

/// The stream for `purpose` (a fixed word such as "reset" or "latents") and `index` (a person, an environment, an epoch).
///
/// Streams of different (seed, purpose, index) are independent, so results do not depend on how work is spread over threads.
pub fn stream(seed: u64, purpose: &str, index: u64) -> Stream {
    let mut hash = Sha256::new();
    hash.update(seed.to_le_bytes());
    hash.update(index.to_le_bytes());
    hash.update(purpose.as_bytes());
    Stream::from_seed(hash.finalize().into())
}
