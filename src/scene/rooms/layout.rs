//! How rooms of each kind are laid out.

use super::furniture::{Kind, Piece};
use super::plan::Plan;
use super::shell::{DOOR_WIDTH, Door, Shell};
use crate::Result;
use crate::rng::Stream;
use glam::{DVec2, Vec2, Vec3};
use rand::RngExt;
use std::f32::consts::{FRAC_PI_2, PI};

/// Walls, doors and furniture of a room.
pub type Layout = (Shell, Vec<Piece>);

/// A living room, dining room, bedroom or office; larger, fuller and less tidy with the difficulty.
pub fn furnished(difficulty: f32, rng: &mut Stream) -> Result<Layout> {
    let d = f64::from(difficulty);
    let size = DVec2::new(
        rng.random_range(4.4..5.6) + d * rng.random_range(0.8..2.2),
        rng.random_range(3.7..4.5) + d * rng.random_range(0.2..1.1),
    );
    let mut cuts = [DVec2::ZERO; 4];
    if rng.random_range(0.0..1.0) < 0.4 {
        cuts[rng.random_range(0..4)] = size * DVec2::new(rng.random_range(0.2..0.4), rng.random_range(0.2..0.45));
    }
    let mut shell = Shell::with_cuts(size, cuts);
    let doors = 1 + rng.random_range(0..3) / 2;
    add_doors(&mut shell, doors, rng);
    let mut plan = Plan::new(shell, rng)?;
    // The large pieces first, while there is room.
    match plan.rng.random_range(0..4) {
        0 => {
            seats(&mut plan);
            if difficulty > 0.3 {
                dining(&mut plan, difficulty);
            }
        }
        1 => {
            dining(&mut plan, difficulty);
            if difficulty > 0.5 {
                seats(&mut plan);
            }
        }
        2 => {
            bed(&mut plan);
            desks(&mut plan, 1, true);
        }
        _ => {
            dining(&mut plan, difficulty);
            desks(&mut plan, 1 + (3.0 * difficulty) as usize, false);
        }
    }
    for _ in 0..1 + (2.5 * difficulty).round() as usize {
        island(&mut plan);
    }
    along_walls(&mut plan, &[Kind::Shelf, Kind::Cabinet, Kind::Cabinet, Kind::Plant], (5.0 * difficulty).round() as usize);
    clutter(&mut plan, &[Kind::Chair, Kind::Stool, Kind::Crate, Kind::Plant, Kind::RoundTable], (8.0 * difficulty).round() as usize);
    Ok((plan.shell, plan.pieces))
}

/// A corridor, straight or with a bend, a fork or two bends, with things along its walls; narrower and fuller with the difficulty.
pub fn corridor(difficulty: f32, rng: &mut Stream) -> Result<Layout> {
    let d = f64::from(difficulty);
    let width = rng.random_range(2.1..2.5) - 0.6 * d;
    let size = DVec2::new(rng.random_range(7.0..10.0), rng.random_range(5.0..7.0));
    let none = DVec2::ZERO;
    let shape = rng.random_range(0..4);
    let at = rng.random_range(0.25..0.6);
    let mut shell = match shape {
        0 => Shell::with_cuts(DVec2::new(size.x, width), [none; 4]),
        1 => Shell::with_cuts(size, [none, none, size - width, none]),
        2 => {
            let left = (size.x - width) * at;
            Shell::with_cuts(size, [none, none, DVec2::new(size.x - width - left, size.y - width), DVec2::new(left, size.y - width)])
        }
        _ => {
            let left = (size.x - width) * at;
            let size = DVec2::new(size.x, 2.0 * width + 0.8);
            Shell::with_cuts(size, [none, DVec2::new(size.x - width - left, size.y - width), none, DVec2::new(left, size.y - width)])
        }
    };
    let doors = rng.random_range(3..7);
    add_doors(&mut shell, doors, rng);
    let mut plan = Plan::new(shell, rng)?;
    along_walls(&mut plan, &[Kind::Cabinet, Kind::Bench, Kind::Plant, Kind::Shelf, Kind::Chair], 4 + (6.0 * difficulty).round() as usize);
    clutter(&mut plan, &[Kind::Crate, Kind::Stool, Kind::Plant], 2 + (5.0 * difficulty).round() as usize);
    Ok((plan.shell, plan.pieces))
}

/// A hall with rows of columns, and benches and other things between them; fuller with the difficulty.
pub fn hall(difficulty: f32, rng: &mut Stream) -> Result<Layout> {
    let size = DVec2::new(rng.random_range(8.5..12.5), rng.random_range(6.5..9.0));
    let mut shell = Shell::with_cuts(size, [DVec2::ZERO; 4]);
    add_doors(&mut shell, 4, rng);
    let mut plan = Plan::new(shell, rng)?;
    let kind = if plan.chance(0.5) { Kind::Column } else { Kind::RoundColumn };
    let column = kind.draw_size(plan.rng);
    let apart = plan.within(3.4, 4.2) - 1.2 * difficulty;
    let half = size.as_vec2() / 2.0;
    let rows = |length: f32| ((length - 1.6) / apart).floor().max(1.0);
    let (nx, ny) = (rows(size.x as f32), rows(size.y as f32));
    for (i, j) in (0..nx as usize).flat_map(|i| (0..ny as usize).map(move |j| (i, j))) {
        let steps = Vec2::new(i as f32 - 0.5 * (nx - 1.0), j as f32 - 0.5 * (ny - 1.0));
        let centre = (steps * apart).clamp(-half, half);
        plan.place(Piece { kind, size: column, centre, yaw: 0.0 }, None);
    }
    for _ in 0..(1 + (4.0 * difficulty).round() as usize) {
        let size = Kind::Bench.draw_size(plan.rng);
        plan.anywhere(Kind::Bench, size, 0.0);
    }
    along_walls(&mut plan, &[Kind::Bench, Kind::Plant, Kind::Cabinet], 3 + (5.0 * difficulty).round() as usize);
    clutter(&mut plan, &[Kind::RoundTable, Kind::Plant, Kind::Crate, Kind::Stool], 2 + (8.0 * difficulty).round() as usize);
    Ok((plan.shell, plan.pieces))
}

/// Opens up to `count` doors in walls that are long enough, no two close to each other.
fn add_doors(shell: &mut Shell, count: usize, rng: &mut Stream) {
    let margin = DOOR_WIDTH / 2.0 + 0.15;
    for _ in 0..20 * count {
        let wall = rng.random_range(0..shell.ring.len());
        let (a, along, length) = shell.wall(wall);
        if shell.doors.len() >= count || length < 2.0 * margin + 0.1 {
            continue;
        }
        let at = rng.random_range(margin..length - margin);
        let middle = |d: &Door| {
            let [p, q] = shell.opening(d);
            0.5 * (p + q)
        };
        if shell.doors.iter().all(|d| middle(d).distance(a + along * at) > 1.6) {
            shell.doors.push(Door { wall, at });
        }
    }
}

/// A sofa with a low table before it, armchairs beside the table, and a cabinet somewhere.
fn seats(plan: &mut Plan) {
    let size = Kind::Sofa.draw_size(plan.rng);
    let Some(sofa) = plan.at_wall(Kind::Sofa, size) else { return };
    let low = Vec3::new(plan.within(0.8, 1.2), plan.within(0.5, 0.65), plan.within(0.38, 0.45));
    let ahead = -(size.y / 2.0 + plan.within(0.35, 0.5) + low.y / 2.0);
    let table = if plan.chance(0.3) { (Kind::RoundTable, Vec3::new(0.8, 0.8, 0.45)) } else { (Kind::Table, low) };
    plan.beside(sofa, table.0, table.1, Vec2::new(0.0, ahead), 0.0);
    for side in [-1.0f32, 1.0] {
        if plan.chance(0.6) {
            let seat = Vec3::new(plan.within(0.78, 0.9), plan.within(0.75, 0.85), size.z);
            let offset = Vec2::new(side * (0.6 * low.x + 0.45 + seat.y / 2.0), ahead + plan.within(-0.3, 0.3));
            let turn = plan.within(-0.3, 0.3) - side * FRAC_PI_2;
            plan.beside(sofa, Kind::Sofa, seat, offset, turn);
        }
    }
    let cabinet = Kind::Cabinet.draw_size(plan.rng);
    plan.at_wall(Kind::Cabinet, cabinet);
}

/// A table with chairs on its sides, more or less pulled out.
fn dining(plan: &mut Plan, difficulty: f32) {
    let size = Kind::Table.draw_size(plan.rng);
    let skew = if plan.chance(0.3) { 0.4 } else { 0.05 };
    let Some(table) = plan.anywhere(Kind::Table, size, skew) else { return };
    let seats = ((size.x - 0.2) / 0.6) as usize;
    let mut places = Vec::new();
    for k in 0..seats {
        let x = (k as f32 + 0.5) / seats as f32 * (size.x - 0.2) - 0.5 * (size.x - 0.2);
        places.extend([(Vec2::new(x, size.y / 2.0), 0.0), (Vec2::new(x, -size.y / 2.0), PI)]);
    }
    places.extend([(Vec2::new(-size.x / 2.0, 0.0), FRAC_PI_2), (Vec2::new(size.x / 2.0, 0.0), -FRAC_PI_2)]);
    let chair = Kind::Chair.draw_size(plan.rng);
    for (at, turn) in places {
        if plan.chance(0.8) {
            // From nearly tucked in to half a metre away.
            let out = chair.y * 0.5 - 0.18 + plan.within(0.0, 0.1 + 0.35 * difficulty);
            let twist = plan.within(-0.25, 0.25) * difficulty;
            plan.beside(table, Kind::Chair, chair, at + out * Vec2::from_angle(turn + FRAC_PI_2), turn + twist);
        }
    }
}

/// A bed with its head to a wall and night tables beside it.
fn bed(plan: &mut Plan) {
    let size = Kind::Bed.draw_size(plan.rng);
    let Some(bed) = plan.at_wall(Kind::Bed, size) else { return };
    let night = Vec3::new(plan.within(0.38, 0.5), plan.within(0.35, 0.42), plan.within(0.45, 0.55));
    for side in [-1.0, 1.0] {
        let offset = Vec2::new(side * (size.x / 2.0 + 0.04 + night.x / 2.0), size.y / 2.0 - night.y / 2.0);
        plan.beside(bed, Kind::Cabinet, night, offset, 0.0);
    }
}

/// Desks, at walls or anywhere, each with a chair before it.
fn desks(plan: &mut Plan, count: usize, walls: bool) {
    for _ in 0..count {
        let size = Kind::Desk.draw_size(plan.rng);
        let desk = if walls || plan.chance(0.4) { plan.at_wall(Kind::Desk, size) } else { plan.anywhere(Kind::Desk, size, 0.0) };
        let chair = Kind::Chair.draw_size(plan.rng);
        if let Some(desk) = desk {
            let out = size.y / 2.0 + chair.y / 2.0 + plan.within(-0.12, 0.25);
            let turn = PI + plan.within(-0.4, 0.4);
            let offset = Vec2::new(plan.within(-0.1, 0.1), -out);
            plan.beside(desk, Kind::Chair, chair, offset, turn);
        }
    }
}

/// Something to walk round in a room whose furniture otherwise is at its walls.
fn island(plan: &mut Plan) {
    let kind = [Kind::RoundTable, Kind::Bench, Kind::Table][plan.rng.random_range(0..3)];
    let size = kind.draw_size(plan.rng);
    plan.anywhere(kind, size, 0.3);
}

fn along_walls(plan: &mut Plan, kinds: &[Kind], count: usize) {
    for _ in 0..count {
        let kind = kinds[plan.rng.random_range(0..kinds.len())];
        let size = kind.draw_size(plan.rng);
        plan.at_wall(kind, size);
    }
}

fn clutter(plan: &mut Plan, kinds: &[Kind], count: usize) {
    for _ in 0..count {
        let kind = kinds[plan.rng.random_range(0..kinds.len())];
        let size = kind.draw_size(plan.rng);
        plan.anywhere(kind, size, 0.8);
    }
}
