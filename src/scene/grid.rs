//! Grids of square cells on the floor: filling, closing, parts, borders.

use super::Polygon;
use super::rings::{ring_edges, signed_area};
use crate::{Error, Result};
use glam::DVec2;

/// Most cells of a grid.
const MAX_CELLS: f64 = 5e7;

/// A grid of square cells, each set or not.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Grid {
    /// Lower corner of the first cell, metres.
    pub lowest: DVec2,
    /// Side of a cell, metres.
    pub cell: f64,
    /// Cells along x and y.
    pub dims: [usize; 2],
    /// Whether each cell is set; x runs fastest.
    pub cells: Vec<bool>,
}

impl Grid {
    /// A grid of unset cells over the box `low..high` with at least `border` metres to spare. Whole multiples of the cell lie in the
    /// middle of cells, so that what was built on them falls on no border.
    ///
    /// Errors: an empty or endless box, or more than 50 million cells.
    pub fn covering(low: DVec2, high: DVec2, cell: f64, border: f64) -> Result<Self> {
        let (low, high) = (low - border - 2.0 * cell, high + border + 2.0 * cell);
        let first = (low / cell).floor() - 0.5;
        let dims = ((high / cell) - first).ceil();
        if !(dims.is_finite() && dims.min_element() > 0.0 && dims.x * dims.y <= MAX_CELLS) {
            return Err(Error::invalid(format!("a floor from {low} to {high} m cannot be laid out in cells of {cell} m")));
        }
        let dims = [dims.x as usize, dims.y as usize];
        Ok(Self { lowest: first * cell, cell, dims, cells: vec![false; dims[0] * dims[1]] })
    }

    /// The cells whose centres lie in the walkable area, on a grid that covers it.
    pub fn of_polygon(polygon: &Polygon, cell: f64) -> Result<Self> {
        let (low, high) = polygon.bounds();
        let mut grid = Self::covering(low, high, cell, 0.0)?;
        grid.fill(polygon.exterior(), true);
        polygon.holes().iter().for_each(|hole| grid.fill(hole, false));
        Ok(grid)
    }

    /// The same with cells of side `cell`, or as much larger as it takes for about `most` of them to cover the area.
    pub fn of_polygon_within(polygon: &Polygon, cell: f64, most: f64) -> Result<Self> {
        let (low, high) = polygon.bounds();
        let size = high - low;
        Self::of_polygon(polygon, (size.x * size.y / most).sqrt().max(cell))
    }

    /// Gives all cells whose centres lie within the ring this value.
    pub fn fill(&mut self, ring: &[DVec2], value: bool) {
        let row = |y: f64| (((y - self.lowest.y) / self.cell).floor().max(0.0) as usize).min(self.dims[1]);
        let (low, high) = ring.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), p| (l.min(p.y), h.max(p.y)));
        for j in row(low)..row(high + self.cell) {
            let y = self.lowest.y + (j as f64 + 0.5) * self.cell;
            let crossed = ring_edges(ring).filter(|(a, b)| (a.y > y) != (b.y > y));
            let mut at: Vec<f64> = crossed.map(|(a, b)| a.x + (y - a.y) / (b.y - a.y) * (b.x - a.x)).collect();
            at.sort_by(f64::total_cmp);
            at.as_chunks::<2>().0.iter().for_each(|&[from, to]| self.set_centres(j, from, to, value));
        }
    }

    /// Gives the cells of row `j` whose centres lie in `from..=to` this value.
    pub(crate) fn set_centres(&mut self, j: usize, from: f64, to: f64, value: bool) {
        let first = ((from - self.lowest.x) / self.cell - 0.5).ceil().max(0.0);
        let last = ((to - self.lowest.x) / self.cell - 0.5).floor().min(self.dims[0] as f64 - 1.0);
        if first <= last {
            self.cells[j * self.dims[0]..][first as usize..=last as usize].fill(value);
        }
    }

    /// Centre of cell `(i, j)`, metres.
    pub fn centre(&self, i: usize, j: usize) -> DVec2 {
        self.lowest + (DVec2::new(i as f64, j as f64) + 0.5) * self.cell
    }

    /// Centres of the set cells, metres.
    pub fn centres(&self) -> impl Iterator<Item = DVec2> {
        let set = self.cells.iter().enumerate().filter(|(_, set)| **set);
        set.map(|(k, _)| self.centre(k % self.dims[0], k / self.dims[0]))
    }

    /// Whether the cell of `p` is set.
    pub fn holds(&self, p: DVec2) -> bool {
        let at = (p - self.lowest) / self.cell;
        let within = at.min_element() >= 0.0 && at.x < self.dims[0] as f64 && at.y < self.dims[1] as f64;
        within && self.cells[at.y as usize * self.dims[0] + at.x as usize]
    }

    /// Area of the set cells, square metres.
    pub fn area(&self) -> f64 {
        self.cells.iter().filter(|&&c| c).count() as f64 * self.cell * self.cell
    }

    /// The cells that this one has not set.
    pub fn inverse(&self) -> Self {
        Self { cells: self.cells.iter().map(|c| !c).collect(), ..self.clone() }
    }

    /// With gaps between set cells closed into which no disk of `radius` fits.
    pub fn closed(&self, radius: f64) -> Self {
        self.grown(radius).inverse().grown(radius).inverse()
    }

    /// The set cells and all whose centres are no farther than `radius` from those of one.
    fn grown(&self, radius: f64) -> Self {
        let reach = (radius / self.cell).floor() as i64;
        let disk: Vec<(i64, i64)> = (-reach..=reach).flat_map(|y| (-reach..=reach).map(move |x| (x, y))).collect();
        let disk: Vec<_> = disk.into_iter().filter(|(x, y)| ((x * x + y * y) as f64) * self.cell * self.cell <= radius * radius).collect();
        let mut out = self.clone();
        let [w, h] = self.dims.map(|d| d as i64);
        let at = |x: i64, y: i64| (x >= 0 && y >= 0 && x < w && y < h).then(|| (y * w + x) as usize);
        for i in (0..w * h).filter(|&i| self.cells[i as usize]) {
            let (x, y) = (i % w, i / w);
            let inner = [(1, 0), (-1, 0), (0, 1), (0, -1)].iter().all(|(dx, dy)| at(x + dx, y + dy).is_none_or(|k| self.cells[k]));
            if !inner {
                disk.iter().filter_map(|(dx, dy)| at(x + dx, y + dy)).for_each(|k| out.cells[k] = true);
            }
        }
        out
    }

    /// The largest set of cells that hang together by their sides; nothing where none is set.
    pub fn largest_part(&self) -> Option<Self> {
        let w = self.dims[0];
        let mut seen = vec![false; self.cells.len()];
        let mut best: Vec<usize> = Vec::new();
        for start in 0..self.cells.len() {
            if !self.cells[start] || seen[start] {
                continue;
            }
            let (mut part, mut next) = (vec![start], 0);
            seen[start] = true;
            while let Some(&k) = part.get(next) {
                next += 1;
                let sides = [(k % w > 0).then(|| k - 1), (k % w + 1 < w).then_some(k + 1), k.checked_sub(w), Some(k + w)];
                for side in sides.into_iter().flatten().filter(|&s| s < self.cells.len()) {
                    if self.cells[side] && !seen[side] {
                        seen[side] = true;
                        part.push(side);
                    }
                }
            }
            if part.len() > best.len() {
                best = part;
            }
        }
        let mut out = Self { cells: vec![false; self.cells.len()], ..self.clone() };
        best.iter().for_each(|&k| out.cells[k] = true);
        (!best.is_empty()).then_some(out)
    }

    /// Borders of the set cells by marching squares over their centres: counter-clockwise around them, clockwise around what they
    /// enclose, the largest first. The corners are those of the cells; cells that touch only at a corner are apart, cut off there.
    pub fn contours(&self) -> Vec<Vec<DVec2>> {
        let [w, h] = self.dims;
        // Of each crossed link between two centres (2 k: to the right, 2 k + 1: upwards) the next one along the border, and whether
        // the way there goes round a corner.
        let mut next = vec![(u32::MAX, false); 2 * w * h];
        for j in 0..h.saturating_sub(1) {
            for i in 0..w.saturating_sub(1) {
                let k = j * w + i;
                let set = [k, k + 1, k + w + 1, k + w].map(|c| usize::from(self.cells[c]));
                let links = [2 * k, 2 * (k + 1) + 1, 2 * (k + w), 2 * k + 1];
                let steps = STEPS[set[0] + 2 * set[1] + 4 * set[2] + 8 * set[3]];
                for &(from, to) in steps {
                    next[links[from]] = (links[to] as u32, steps.len() == 1 && (from + to) % 2 == 1);
                }
            }
        }
        let point = |link: usize| {
            let half = if link.is_multiple_of(2) { DVec2::X } else { DVec2::Y } * 0.5 * self.cell;
            self.centre(link / 2 % w, link / 2 / w) + half
        };
        let mut rings = Vec::new();
        for start in 0..next.len() {
            let (mut ring, mut link) = (Vec::new(), start);
            while next[link].0 != u32::MAX {
                let (to, corner) = std::mem::replace(&mut next[link], (u32::MAX, false));
                let (p, q) = (point(link), point(to as usize));
                ring.push(p);
                if corner {
                    ring.push(if link.is_multiple_of(2) { DVec2::new(p.x, q.y) } else { DVec2::new(q.x, p.y) });
                }
                link = to as usize;
            }
            if !ring.is_empty() {
                rings.push(ring);
            }
        }
        rings.sort_by(|a, b| signed_area(b).total_cmp(&signed_area(a)));
        rings
    }
}

const BOTTOM: usize = 0;
const RIGHT: usize = 1;
const TOP: usize = 2;
const LEFT: usize = 3;

/// Steps of the border through a square of four centres, with the set ones on its left, by which of them are set: 1 lower left,
/// 2 lower right, 4 upper right, 8 upper left.
const STEPS: [&[(usize, usize)]; 16] = [
    &[],
    &[(BOTTOM, LEFT)],
    &[(RIGHT, BOTTOM)],
    &[(RIGHT, LEFT)],
    &[(TOP, RIGHT)],
    &[(BOTTOM, LEFT), (TOP, RIGHT)],
    &[(TOP, BOTTOM)],
    &[(TOP, LEFT)],
    &[(LEFT, TOP)],
    &[(BOTTOM, TOP)],
    &[(RIGHT, BOTTOM), (LEFT, TOP)],
    &[(RIGHT, TOP)],
    &[(LEFT, RIGHT)],
    &[(BOTTOM, RIGHT)],
    &[(LEFT, BOTTOM)],
    &[],
];

#[cfg(test)]
mod tests {
    use super::*;

    /// Rows of text from top to bottom, # for set cells of 1 m; the lower left cell has its centre at the origin.
    fn grid(rows: &[&str]) -> Grid {
        let cells = rows.iter().rev().flat_map(|r| r.bytes().map(|b| b == b'#')).collect();
        Grid { lowest: DVec2::splat(-0.5), cell: 1.0, dims: [rows[0].len(), rows.len()], cells }
    }

    #[test]
    fn contours_by_hand() {
        let rings = grid(&[".......", ".#####.", ".#...#.", ".#.#.#.", ".#...#.", ".#####.", "......."]).contours();
        // A frame of 5 x 5 around 3 x 3 around one cell.
        let areas: Vec<f64> = rings.iter().map(|r| signed_area(r)).collect();
        assert_eq!(areas, [25.0, 1.0, -9.0]);
        assert!(rings[1].contains(&DVec2::new(3.5, 3.0)) && rings[1].contains(&DVec2::new(3.5, 2.5)));
    }

    #[test]
    fn cells_that_touch_at_corners_are_apart() {
        let g = grid(&["....", ".#..", "..#.", "...."]);
        // Each without the triangle of 1/8 by which it touched the other.
        assert_eq!(g.contours().iter().map(|r| signed_area(r)).collect::<Vec<_>>(), [0.875; 2]);
        assert_eq!(g.largest_part().unwrap().area(), 1.0);
        assert_eq!(grid(&["...", "..."]).largest_part(), None);
        assert_eq!(grid(&["##.", "#..", "#.#"]).largest_part().unwrap(), grid(&["##.", "#..", "#.."]));
    }

    #[test]
    fn closing_fills_slits_but_no_rooms() {
        let slit = grid(&[".........", "..##.##..", "..##.##..", "..##.##..", "..##.##..", "........."]);
        let closed = slit.closed(1.0);
        assert_eq!(closed.area() as usize, 16 + 2, "the ends of the slit stay open");
        let room = grid(&["...........", "..##...##..", "..##...##..", "..##...##..", "..........."]);
        assert_eq!(room.closed(1.0), room);
    }

    #[test]
    fn polygons_fill_the_centres_within() {
        let ring = |half: f64| [(-half, -half), (half, -half), (half, half), (-half, half)].map(DVec2::from).to_vec();
        let grid = Grid::of_polygon(&Polygon::new(ring(2.05), vec![ring(0.55)]).unwrap(), 0.1).unwrap();
        // Centres at multiples of 0.1 m: 41 x 41 of them less 11 x 11.
        assert!((grid.area() - 15.6).abs() < 1e-9, "{}", grid.area());
        assert_eq!(grid.centres().count(), 1560);
        assert!(grid.centres().all(|p| p.abs().max_element() < 2.05 && p.abs().max_element() > 0.55));
        let at = |x: f64, y: f64| grid.holds(DVec2::new(x, y));
        assert!(at(1.0, 1.0) && !at(0.0, 0.0) && !at(2.2, 0.0) && at(0.0, -1.8));
        // 10 km of 0.02 m would be 250 thousand million.
        let far = Polygon::new(ring(5000.0), vec![]).unwrap();
        let coarse = Grid::of_polygon_within(&far, 0.02, 1e4).unwrap();
        assert!(coarse.cells.len() < 12_000 && (coarse.area() / 1e8 - 1.0).abs() < 0.03, "{}", coarse.area());
        assert_eq!(Grid::of_polygon_within(&far, 200.0, 1e4).unwrap().cell, 200.0);
        assert!(Grid::covering(DVec2::ZERO, DVec2::splat(1e6), 0.01, 0.0).is_err());
    }
}
