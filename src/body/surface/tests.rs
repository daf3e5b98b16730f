use super::super::tests::random_params;
use super::*;
use crate::body::BETAS;

/// Depth and count over all vertices, one by one.
fn brute(model: &BodyModel, body: &ShapedBody, posed: &Posed, to_world: &Frame, distance: impl Fn(Vec3) -> f32) -> Inside {
    let (mut vertices, weights) = (Vec::new(), smplx_weights(model));
    model.skin(body, posed, &mut vertices);
    vertices.iter().zip(weights).fold(Inside::default(), |sum, (v, w)| {
        let d = distance(to_world.point(*v)).min(0.0);
        Inside { count: sum.count + if d < 0.0 { w } else { 0.0 }, depth: sum.depth - w * d }
    })
}

/// Distance to a box of half sides `h` at `c`.
fn boxed(c: Vec3, h: Vec3) -> impl Fn(Vec3) -> f32 {
    move |p| {
        let q = (p - c).abs() - h;
        q.max(Vec3::ZERO).length() + q.max_element().min(0.0)
    }
}

#[test]
fn weights_make_the_vertices_of_smplx() {
    let model = BodyModel::embedded();
    let total: f32 = smplx_weights(&model).iter().sum();
    assert!((total - (10475.0 - 502.0)).abs() < 1.0, "{total}");
    for points in [Points::All, Points::Spread(800)] {
        let surface = Surface::new(&model, points);
        let sum: f32 = surface.points.iter().map(|p| p.1).sum();
        assert!((sum - total).abs() < 1.0, "{sum}");
        assert!(surface.points.iter().all(|p| !model.foot_vertices().contains(&p.0)));
    }
}

/// Obstacles of an exact distance.
struct Exact<F>(F);

impl<F: Fn(Vec3) -> f32> Obstacles for Exact<F> {
    fn distances(&self, at: &Group, out: &mut Lanes) {
        out.0 = std::array::from_fn(|l| self.0(point(at, l)));
    }

    fn slack(&self) -> f32 {
        0.0
    }
}

fn point(group: &Group, l: usize) -> Vec3 {
    Vec3::from(group.map(|axis| axis.0[l]))
}

/// One frame.
fn still(surface: &ShapedSurface, body: &ShapedBody, params: &[f32], to_world: &Frame, distance: impl Fn(Vec3) -> f32) -> Inside {
    let mut joints = [0.0; 3 * JOINTS];
    body.pose(params).write_joints(&mut joints);
    surface.over(&Moving { body, params, joints: &joints, to_world }, &Exact(distance))[0]
}

#[test]
fn passing_over_parts_and_clusters_changes_nothing() {
    let model = BodyModel::embedded();
    let surface = Arc::new(Surface::new(&model, Points::All));
    let mut touched = 0;
    for k in 0..40u64 {
        let betas = [0.5 * ((k % 5) as f32 - 2.0); BETAS];
        let body = model.shape(&betas);
        let params = random_params(k);
        let posed = body.pose(&params);
        let to_world = Frame::planar(0.3 * k as f32, 0.1 * k as f32, -0.2);
        let pelvis = to_world.point(posed.pos[0]);
        let distance = boxed(pelvis + Vec3::new(0.35, 0.05 * k as f32 - 1.0, 0.1), Vec3::new(0.3, 0.4, 0.5));
        let (got, want) =
            (still(&surface.shape(&body), &body, &params, &to_world, &distance), brute(&model, &body, &posed, &to_world, &distance));
        assert!((got.count - want.count).abs() <= 1e-3 * want.count && (got.depth - want.depth).abs() <= 1e-3 * want.depth + 1e-4);
        touched += usize::from(want.count > 0.0);
    }
    assert!((10..40).contains(&touched), "{touched} of 40 bodies touch the box");
}

#[test]
fn parts_and_clusters_stay_within_their_balls() {
    let model = BodyModel::embedded();
    let surface = Arc::new(Surface::new(&model, Points::All));
    let (mut sizes, mut count) = (0.0, 0.0);
    for k in 0..60u64 {
        let body = model.shape(&[0.5 * ((k % 5) as f32 - 2.0); BETAS]);
        let (shaped, posed) = (surface.shape(&body), body.pose(&random_params(k)));
        let mut bones = Vec::new();
        place(&body, &posed, &Frame::IDENTITY, &mut bones);
        for (region, reach) in surface.regions.iter().zip(&shaped.reach) {
            let (mut at, mut apart, mut points) = (Group::default(), Lanes::default(), Group::default());
            for (n, c) in region.clusters.clone().enumerate() {
                let (group, l) = (region.groups.start + n / LANES, n % LANES);
                let (middles, radii) = &shaped.balls[group];
                surface.middles.skin(group, &bones, middles, &mut at);
                surface.spreads.spread(group, &bones, middles, &at, &mut apart);
                shaped.skin(c, &posed, &bones, &mut points);
                let (ball, part) = (radii.0[l] + apart.0[l], region.part.middle(&posed.pos));
                (sizes, count) = (sizes + ball, count + 1.0);
                for p in (0..LANES).map(|l| point(&points, l)) {
                    assert!(p.distance(part) <= reach + 1e-4, "a point {} m from the middle of a ball of {reach} m", p.distance(part));
                    let far = p.distance(point(&at, l));
                    assert!(far <= ball, "a point {far} m from the middle of a cluster's ball of {ball} m");
                }
            }
        }
    }
    let widest = surface.shape(&model.shape(&[0.0; BETAS])).reach.iter().copied().fold(0.0, f32::max);
    assert!(widest < 0.45 && sizes / count < 0.05, "balls of up to {widest} m, and on average of {} m, leave out little", sizes / count);
}

#[test]
fn frames_of_a_motion_are_those_one_by_one() {
    let model = BodyModel::embedded();
    let surface = Arc::new(Surface::new(&model, Points::Spread(1000)));
    let body = model.shape(&[0.0; BETAS]);
    let shaped = surface.shape(&body);
    // 23 frames of a figure that slides past a box in different poses.
    let mut params: Vec<f32> = Vec::new();
    for t in 0..23 {
        let mut frame = random_params(t / 4);
        frame[..3].copy_from_slice(&[0.06 * t as f32 - 0.7, 0.2, 1.0]);
        params.extend(frame);
    }
    let joints: Vec<f32> = params.chunks_exact(PARAMS).flat_map(|p| body.pose(p).pos).flat_map(|p| p.to_array()).collect();
    let distance = boxed(Vec3::new(0.9, 0.3, 0.5), Vec3::new(0.4, 0.5, 0.7));
    let got = shaped.over(&Moving { body: &body, params: &params, joints: &joints, to_world: &Frame::IDENTITY }, &Exact(&distance));
    let want: Vec<Inside> = params.chunks_exact(PARAMS).map(|p| still(&shaped, &body, p, &Frame::IDENTITY, &distance)).collect();
    assert_eq!(got, want);
    assert!(got[0].count == 0.0 && got[22].count > 0.0);
}

#[test]
fn a_wall_at_a_known_depth() {
    // A wall through the upright rest pose: half spaces below and above everything, and one that cuts nothing off but a hand.
    let model = BodyModel::embedded();
    let surface = Arc::new(Surface::new(&model, Points::All));
    let body = model.shape(&[0.0; BETAS]);
    let posed = body.pose(&[0.0; PARAMS]);
    let shaped = surface.shape(&body);
    let inside = |x: f32| still(&shaped, &body, &[0.0; PARAMS], &Frame::IDENTITY, |p| x - p.x);
    assert_eq!(inside(3.0), Inside::default());
    // All 9,973, each as deep as it lies right of the plane at -3 m: the body is symmetric, so 3 m on average.
    let all = inside(-3.0);
    assert!((all.count - 9973.0).abs() < 1.0 && (all.depth / all.count - 3.0).abs() < 0.01, "{all:?}");
    // The left hand alone: 778.
    let wrist = posed.pos[20].x;
    let hand = inside(wrist + 0.005);
    assert!((600.0..=800.0).contains(&hand.count), "{hand:?}");
}

#[test]
fn spread_points_stand_for_their_surroundings() {
    let model = BodyModel::embedded();
    let (all, few) = (Arc::new(Surface::new(&model, Points::All)), Arc::new(Surface::new(&model, Points::Spread(1500))));
    assert!(few.len() < 1600 && all.len() > 5 * few.len());
    let body = model.shape(&[0.0; BETAS]);
    let (all, few) = (all.shape(&body), few.shape(&body));
    for k in 0..20 {
        let params = random_params(100 + k);
        let at = body.pose(&params).pos[0].x + 0.04 * k as f32 - 0.3;
        let inside = |s: &ShapedSurface| still(s, &body, &params, &Frame::IDENTITY, |p| at - p.x);
        let (a, b) = (inside(&all), inside(&few));
        assert!((a.count - b.count).abs() < 0.03 * a.count + 30.0, "{a:?} {b:?}");
        assert!((a.depth - b.depth).abs() < 0.03 * a.depth + 1.0, "{a:?} {b:?}");
    }
}
