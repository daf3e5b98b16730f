//! Sixteen points at a time: skinning them, and looking them up in a grid of distances.

use super::simd::{Isa, multiversion};

/// Points that are worked on together.
pub const LANES: usize = 16;
/// Most samples of a grid, so that their numbers are exact.
const MOST: usize = 1 << 30;

/// One number of each of sixteen points.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(C, align(64))]
pub struct Lanes(pub [f32; LANES]);

/// x, y and z of sixteen points.
pub type Group = [Lanes; 3];

/// What a bone does to a point: the rows of a rotation, each with the translation behind it.
pub type Bone = [[f32; 4]; 3];

impl Default for Lanes {
    fn default() -> Self {
        Self([0.0; LANES])
    }
}

/// Bones with a number for each of sixteen points, group of points by group of points.
#[derive(Clone, Debug, Default)]
pub struct Pulls {
    bones: Vec<u32>,
    weights: Vec<Lanes>,
    /// Where the entries of each group end.
    ends: Vec<usize>,
}

impl Pulls {
    /// Adds a group's bones.
    pub fn push(&mut self, entries: impl IntoIterator<Item = (usize, Lanes)>) {
        for (bone, weights) in entries {
            self.bones.push(bone as u32);
            self.weights.push(weights);
        }
        self.ends.push(self.bones.len());
    }

    /// How many groups there are.
    pub fn groups(&self) -> usize {
        self.ends.len()
    }

    fn of(&self, group: usize) -> (&[u32], &[Lanes]) {
        let start = if group == 0 { 0 } else { self.ends[group - 1] };
        (&self.bones[start..self.ends[group]], &self.weights[start..self.ends[group]])
    }

    /// Where `bones` take the points of `group` that are at `rest`: the sums of where each takes them, times its numbers.
    ///
    /// # Panics
    /// When there is no such group, or no such bone.
    pub fn skin(&self, group: usize, bones: &[Bone], rest: &Group, out: &mut Group) {
        let (used, weights) = self.of(group);
        skin(Isa::best(), bones, used, weights, rest, out);
    }

    /// Of each point of `group` the root of the sum of the squares of the distances from `at` to where each bone takes it, times its numbers.
    ///
    /// # Panics
    /// As [`Pulls::skin`].
    pub fn spread(&self, group: usize, bones: &[Bone], rest: &Group, at: &Group, out: &mut Lanes) {
        let (used, weights) = self.of(group);
        spread(Isa::best(), bones, used, weights, rest, at, out);
    }
}

/// A grid of distances, ready for look-ups.
#[derive(Clone, Copy, Debug)]
pub struct Probe<'a> {
    values: &'a [f32],
    lowest: [f32; 3],
    voxel: f32,
    /// Samples along each axis.
    dims: [i32; 3],
}

impl<'a> Probe<'a> {
    /// The grid whose sample (i, j, k), `values[(i * dims[1] + j) * dims[2] + k]`, is the distance at `lowest + voxel * (i, j, k)`, metres.
    ///
    /// # Panics
    /// When there are not as many values as `dims` says, and at least two a side.
    pub fn new(values: &'a [f32], lowest: [f32; 3], voxel: f32, dims: [usize; 3]) -> Self {
        let count = dims.iter().try_fold(1usize, |n, &d| n.checked_mul(d));
        assert!(dims.iter().all(|&d| d >= 2) && count == Some(values.len()) && values.len() <= MOST, "{} values of {dims:?}", values.len());
        Self { values, lowest, voxel, dims: dims.map(|d| d as i32) }
    }

    /// The distances at sixteen points, metres; see [`crate::scene::SdfGrid::at`].
    pub fn distances(&self, at: &Group, out: &mut Lanes) {
        let (isa, mut place, mut corners) = (Isa::best(), Place::default(), Default::default());
        locate(isa, self, at, &mut place);
        self.corners(&place, &mut corners);
        blend(isa, &place, &corners, out);
    }

    /// Samples from one to the next along each axis.
    fn strides(&self) -> [i32; 3] {
        [self.dims[1] * self.dims[2], self.dims[2], 1]
    }

    /// Loads the samples round each point. Apart, for with wide registers compilers choose gathers, which take three times as long.
    #[inline(never)]
    fn corners(&self, place: &Place, out: &mut Corners) {
        let [x, y, _] = self.strides().map(|s| s as usize);
        for (l, cell) in place.cell.iter().enumerate() {
            for (pairs, offset) in out.iter_mut().zip([0, y, x, x + y]) {
                let first = *cell as usize + offset;
                // SAFETY: `locate` gives cells that are at most the last but one along each axis. So there is one more sample along
                // each, which `Probe::new` has counted.
                pairs[l] = unsafe { [*self.values.get_unchecked(first), *self.values.get_unchecked(first + 1)] };
            }
        }
    }
}

/// Where sixteen points are in a grid.
#[derive(Default)]
pub struct Place {
    /// Lowest sample of the cell.
    cell: [i32; LANES],
    /// From 0 to 1 within it.
    within: [Lanes; 3],
    /// How far beyond the grid, metres.
    beyond: Lanes,
}

/// The samples at the corners of sixteen cells, two along z each: lowest along x and y, next along y, along x, along both.
pub type Corners = [[[f32; 2]; LANES]; 4];

multiversion! {
    skin = skin_body(bones: &[Bone], used: &[u32], weights: &[Lanes], rest: &Group, out: &mut Group)
}

#[inline(always)]
fn skin_body(bones: &[Bone], used: &[u32], weights: &[Lanes], rest: &Group, out: &mut Group) {
    let mut sum = [[0.0; LANES]; 3];
    for (&bone, weights) in used.iter().zip(weights) {
        for (row, sum) in bones[bone as usize].iter().zip(&mut sum) {
            for ((sum, weight), to) in sum.iter_mut().zip(&weights.0).zip(moved(row, rest)) {
                *sum = weight.mul_add(to, *sum);
            }
        }
    }
    for (out, sum) in out.iter_mut().zip(sum) {
        out.0 = sum;
    }
}

multiversion! {
    spread = spread_body(bones: &[Bone], used: &[u32], weights: &[Lanes], rest: &Group, at: &Group, out: &mut Lanes)
}

#[inline(always)]
fn spread_body(bones: &[Bone], used: &[u32], weights: &[Lanes], rest: &Group, at: &Group, out: &mut Lanes) {
    let mut sum = [0.0; LANES];
    for (&bone, weights) in used.iter().zip(weights) {
        let mut squares = [0.0; LANES];
        for (row, at) in bones[bone as usize].iter().zip(at) {
            for ((square, at), to) in squares.iter_mut().zip(&at.0).zip(moved(row, rest)) {
                *square = (to - at).mul_add(to - at, *square);
            }
        }
        for ((sum, weight), square) in sum.iter_mut().zip(&weights.0).zip(squares) {
            *sum = weight.mul_add(square, *sum);
        }
    }
    for (out, sum) in out.0.iter_mut().zip(sum) {
        *out = sum.sqrt();
    }
}

/// One coordinate of where a bone takes points.
#[inline(always)]
fn moved(row: &[f32; 4], rest: &Group) -> [f32; LANES] {
    let mut out = [row[3]; LANES];
    for (rest, entry) in rest.iter().zip(row) {
        for (out, rest) in out.iter_mut().zip(&rest.0) {
            *out = entry.mul_add(*rest, *out);
        }
    }
    out
}

multiversion! {
    locate = locate_body(grid: &Probe<'_>, at: &Group, out: &mut Place)
}

#[inline(always)]
fn locate_body(grid: &Probe<'_>, at: &Group, out: &mut Place) {
    let scale = grid.voxel.recip();
    let mut squares = [0.0f32; LANES];
    for (axis, stride) in grid.strides().into_iter().enumerate() {
        let (last, lowest) = (grid.dims[axis] - 1, grid.lowest[axis]);
        for (l, square) in squares.iter_mut().enumerate() {
            let steps = (at[axis].0[l] - lowest) * scale;
            let held = steps.max(0.0).min(last as f32);
            // SAFETY: it is at least 0, at most 2^30, and a number, for the greater of 0 and what is none is 0.
            let cell = unsafe { held.to_int_unchecked::<i32>() }.min(last - 1);
            out.cell[l] += stride * cell;
            out.within[axis].0[l] = held - cell as f32;
            *square = (steps - held).mul_add(steps - held, *square);
        }
    }
    for (beyond, square) in out.beyond.0.iter_mut().zip(squares) {
        *beyond = square.sqrt() * grid.voxel;
    }
}

multiversion! {
    blend = blend_body(place: &Place, corners: &Corners, out: &mut Lanes)
}

// Plain loops here and above: what closures of the standard library's adaptors do may be compiled without the instruction set.
#[inline(always)]
fn blend_body(place: &Place, corners: &Corners, out: &mut Lanes) {
    let [x, y, z] = &place.within;
    for (l, out) in out.0.iter_mut().enumerate() {
        let mut along_z = [0.0; 4];
        for (v, pairs) in along_z.iter_mut().zip(corners) {
            *v = lerp(pairs[l][0], pairs[l][1], z.0[l]);
        }
        let (low, high) = (lerp(along_z[0], along_z[1], y.0[l]), lerp(along_z[2], along_z[3], y.0[l]));
        let (distance, beyond) = (lerp(low, high, x.0[l]), place.beyond.0[l]);
        *out = if distance < 0.0 { distance + beyond } else { distance.mul_add(distance, beyond * beyond).sqrt() };
    }
}

#[inline(always)]
fn lerp(a: f32, b: f32, t: f32) -> f32 {
    t.mul_add(b - a, a)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::SdfGrid;
    use glam::{Affine3A, Quat, Vec3};
    use rand::RngExt;

    fn lane(points: &[Vec3; LANES]) -> Group {
        [0, 1, 2].map(|axis| Lanes(points.map(|p| p[axis])))
    }

    fn point(points: &Group, l: usize) -> Vec3 {
        Vec3::from([0, 1, 2].map(|axis| points[axis].0[l]))
    }

    #[test]
    fn look_ups_are_those_of_the_grid() {
        let mut rng = crate::rng::stream(1, "points", 0);
        let (dims, voxel) = ([5, 7, 4], 0.1);
        let values = (0..140).map(|_| rng.random_range(-0.4..0.2)).collect();
        let grid = SdfGrid { lowest: Vec3::new(-0.2, 0.1, 0.0), voxel, dims, values };
        let (mut free, mut inside, mut away) = (0, 0, 0);
        for isa in Isa::available() {
            for _ in 0..2000 {
                let mut at: [Vec3; LANES] = std::array::from_fn(|_| Vec3::from([0; 3].map(|_| rng.random_range(-0.4..1.0))));
                (at[0], at[1]) = (grid.highest(), grid.lowest);
                let mut got = Lanes::default();
                let (probe, mut place, mut corners) = (grid.probe(), Place::default(), Default::default());
                locate(isa, &probe, &lane(&at), &mut place);
                probe.corners(&place, &mut corners);
                blend(isa, &place, &corners, &mut got);
                for (p, got) in at.into_iter().zip(got.0) {
                    let want = grid.at(p);
                    assert!((got - want).abs() < 2e-6, "{isa:?} {p}: {got}, expected {want}");
                    free += usize::from(want >= 0.0);
                    inside += usize::from(want < 0.0);
                    away += usize::from(p.cmplt(grid.lowest).any() || p.cmpgt(grid.highest()).any());
                }
            }
        }
        assert!(free > 1000 && inside > 1000 && away > 1000, "{free} {inside} {away}");
        // Farther than any grid, and nowhere.
        let mut got = Lanes::default();
        let far = [1e30, -1e30, f32::INFINITY, f32::NAN].map(Vec3::splat);
        grid.probe().distances(&lane(&std::array::from_fn(|l| far[l % 4])), &mut got);
        assert!(got.0[0] > 1e20 && got.0[1] > 1e20 && got.0[2] == f32::INFINITY && got.0[3].is_nan(), "{got:?}");
    }

    #[test]
    #[should_panic(expected = "7 values of [2, 2, 2]")]
    fn a_grid_without_all_its_values_is_refused() {
        Probe::new(&[0.0; 7], [0.0; 3], 1.0, [2; 3]);
    }

    #[test]
    fn skinning_is_that_of_glam_on_every_instruction_set() {
        let mut rng = crate::rng::stream(2, "points", 0);
        let mut random = |size: f32| rng.random_range(-size..size);
        let maps: [Affine3A; 5] = std::array::from_fn(|_| {
            let turn = Quat::from_scaled_axis(Vec3::from([0; 3].map(|_| random(2.0))));
            Affine3A::from_rotation_translation(turn, Vec3::from([0; 3].map(|_| random(3.0))))
        });
        let bones = maps.map(|m| [0, 1, 2].map(|row| m.matrix3.row(row).extend(m.translation[row]).to_array()));
        let rest: [Vec3; LANES] = std::array::from_fn(|_| Vec3::from([0; 3].map(|_| random(1.0))));
        let mut pulls = Pulls::default();
        pulls.push([(4, Lanes([1.0; LANES]))]);
        let group = [1, 3, 0].map(|bone| (bone, Lanes(std::array::from_fn(|_| random(0.5).abs()))));
        pulls.push(group);
        let (used, weights) = pulls.of(1);
        for isa in Isa::available() {
            let (mut out, mut apart) = (Group::default(), Lanes::default());
            skin(isa, &bones, used, weights, &lane(&rest), &mut out);
            spread(isa, &bones, used, weights, &lane(&rest), &out, &mut apart);
            for (l, p) in rest.iter().enumerate() {
                let to = |&(bone, w): &(usize, Lanes)| (w.0[l], maps[bone].transform_point3(*p));
                let want = group.iter().map(to).fold(Vec3::ZERO, |sum, (w, p)| sum + w * p);
                assert!(point(&out, l).distance(want) < 2e-6, "{isa:?}");
                let square: f32 = group.iter().map(to).map(|(w, p)| w * p.distance_squared(want)).sum();
                assert!((apart.0[l] - square.sqrt()).abs() < 1e-5, "{isa:?}");
            }
        }
        let mut out = Group::default();
        pulls.skin(0, &bones, &lane(&rest), &mut out);
        assert!(point(&out, 7).distance(maps[4].transform_point3(rest[7])) < 2e-6);
    }
}
