//! Random numbers: one generator for each purpose, so that purposes do not disturb each other.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{RngCore, SeedableRng};
use rand_distr::{Distribution, StandardNormal};

use crate::lie::Vec3;

/// A stream of random numbers that depends on the scenario's seed, the machine and the purpose alone.
#[derive(Clone, Debug)]
pub(super) struct Dice {
    generator: ChaCha8Rng,
}

impl Dice {
    pub(super) fn new(seed: u64, machine: &str, purpose: &str) -> Self {
        let mut bytes = [0; 32];
        bytes[..8].copy_from_slice(&seed.to_le_bytes());
        bytes[8..16].copy_from_slice(&digest(machine).to_le_bytes());
        bytes[16..24].copy_from_slice(&digest(purpose).to_le_bytes());
        Self { generator: ChaCha8Rng::from_seed(bytes) }
    }

    /// Mean 0, standard deviation 1.
    pub(super) fn normal(&mut self) -> f64 {
        StandardNormal.sample(&mut self.generator)
    }

    /// Three independent normal numbers.
    pub(super) fn normals(&mut self) -> Vec3 {
        Vec3::new(self.normal(), self.normal(), self.normal())
    }

    /// Uniform in `low..high`.
    pub(super) fn uniform(&mut self, low: f64, high: f64) -> f64 {
        let unit = (self.generator.next_u64() >> 11) as f64 / (1_u64 << 53) as f64;
        low + (high - low) * unit
    }

    /// Three numbers of random sign and of half to all of `magnitude`.
    pub(super) fn offsets(&mut self, magnitude: f64) -> Vec3 {
        let mut one = || {
            let size = magnitude * self.uniform(0.5, 1.0);
            if self.uniform(-1.0, 1.0) < 0.0 { -size } else { size }
        };
        Vec3::new(one(), one(), one())
    }
}

/// FNV-1a, 64 bits.
fn digest(text: &str) -> u64 {
    text.bytes().fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
    })
}
