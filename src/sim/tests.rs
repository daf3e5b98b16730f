//! Tests of the step with a motion model whose paths are known in closed form.

use super::*;
use crate::body::tests::{random_params, toy};
use crate::body::{Frame, HANDS, joint};
use crate::sim::{SeedMotion, yaw_towards};
use glam::{Mat3, Vec2, Vec3};

/// Moves the second seed frame on by `go` in each frame; knows the body of the seed and finds where it stands by two markers.
struct Screw {
    go: Frame,
    shaped: ShapedBody,
    params: Vec<f32>,
    markers: Vec<f32>,
    /// Entry of the prediction that is not finite.
    broken: Option<usize>,
}

impl Screw {
    fn new(body: &BodyModel, people: &People, go: Frame) -> Self {
        let (params, markers) = (people.params[..PARAMS].to_vec(), people.markers[..MARKER_DIM].to_vec());
        Self { go, shaped: body.shape(&people.betas[..BETAS]), params, markers, broken: None }
    }
}

fn point(m: &[f32], i: usize) -> Vec3 {
    Vec3::from_slice(&m[3 * i..])
}

impl MotionModel for Screw {
    fn latent_dim(&self) -> usize {
        2
    }

    fn decode(&self, seed: &[f32], _latent: &[f32], out: &mut [f32]) -> Result<()> {
        for (seed, out) in seed.chunks_exact(SEED * MARKER_DIM).zip(out.chunks_exact_mut(FUTURE * MARKER_DIM)) {
            let mut frame = seed[MARKER_DIM..].to_vec();
            for out in out.chunks_exact_mut(MARKER_DIM) {
                for p in frame.as_chunks_mut::<3>().0 {
                    *p = self.go.point((*p).into()).to_array();
                }
                out.copy_from_slice(&frame);
            }
        }
        self.broken.into_iter().for_each(|i| out[i] = f32::NAN);
        Ok(())
    }

    fn regress(&self, markers: &[f32], _betas: &[f32], out: &mut [f32]) -> Result<()> {
        let angle = |m: &[f32]| (point(m, 7) - point(m, 40)).truncate().to_angle();
        for (m, out) in markers.chunks_exact(MARKER_DIM).zip(out.chunks_exact_mut(PARAMS)) {
            let rot = Mat3::from_rotation_z(angle(m) - angle(&self.markers));
            let moved = Frame { rot, transl: point(m, 7) - rot * point(&self.markers, 7) };
            out.copy_from_slice(&self.params);
            self.shaped.transform_params(out, &moved);
        }
        Ok(())
    }

    fn hash(&self) -> &str {
        "screw"
    }
}

/// [`Screw`] behind frames that start at the pelvis; knows how high that is.
struct Lowered(Screw, f32);

impl MotionModel for Lowered {
    fn latent_dim(&self) -> usize {
        self.0.latent_dim()
    }

    fn decode(&self, seed: &[f32], latent: &[f32], out: &mut [f32]) -> Result<()> {
        for (low, high) in seed[..MARKER_DIM].chunks_exact(3).zip(self.0.markers.chunks_exact(3)) {
            assert!((high[2] - low[2] - self.1).abs() < 1e-5, "{high:?} arrives as {low:?}");
        }
        self.0.decode(seed, latent, out)
    }

    fn regress(&self, markers: &[f32], betas: &[f32], out: &mut [f32]) -> Result<()> {
        self.0.regress(markers, betas, out)
    }

    fn hash(&self) -> &str {
        "lowered"
    }

    fn origin(&self) -> Origin {
        Origin::Pelvis
    }
}

const BETA: [f32; BETAS] = [0.5; BETAS];

/// `n` people on the seed that walks by `go` per frame, each turned and placed differently, and the model that moves them.
fn walkers(n: usize, go: Frame) -> (People, Arc<BodyModel>, Screw) {
    let body = Arc::new(toy());
    let mut one = People::new(1);
    let still = SeedMotion { params: [random_params(3), random_params(3)].concat(), betas: BETA };
    one.place(0, &body, &still, 0.0, 0.0, 0.0).unwrap();
    let mut seed = SeedMotion { params: one.params, betas: BETA };
    body.shape(&BETA).transform_params(&mut seed.params[PARAMS..], &go);
    let mut people = People::new(n);
    for i in 0..n {
        people.place(i, &body, &seed, 0.7 * i as f32, i as f32, -2.0 * i as f32).unwrap();
    }
    let model = Screw::new(&body, &people, go);
    (people, body, model)
}

#[test]
fn placing_faces_and_stands_as_asked() {
    let (people, ..) = walkers(3, Frame::planar(0.0, 0.0, 0.03));
    for i in 0..3 {
        let joints = &people.joints[i * SEED * JOINT_DIM..][..JOINT_DIM];
        assert!(point(joints, joint::PELVIS).truncate().length() < 1e-5);
        let across = point(joints, joint::R_HIP) - point(joints, joint::L_HIP);
        assert!(across.x > 0.0 && across.y.abs() < 1e-5);
        let pelvis = people.frames[i].point(point(joints, joint::PELVIS));
        assert!((pelvis.truncate() - Vec2::new(i as f32, -2.0 * i as f32)).length() < 1e-5);
    }
    for (dx, dy) in [(1.0, 0.0), (0.0, -1.0), (-0.6, 0.8)] {
        let forward = Frame::planar(yaw_towards(dx, dy), 0.0, 0.0).rot.y_axis;
        assert!((forward - Vec3::new(dx, dy, 0.0)).length() < 1e-6);
    }
}

/// After any number of steps frame t stands where the screw motion takes the first frame in 18 s + t goes.
fn follows(go: Frame, steps: usize, every: usize) {
    let (mut people, body, model) = walkers(2, go);
    let start = people.clone();
    let sim = Sim::new(body, Arc::new(model));
    let mut out = Primitives::default();
    for s in 0..steps {
        sim.step_by(every, &mut people, &[0.0; 4], &mut out).unwrap();
        for i in 0..2 {
            for t in 0..FRAMES {
                let moved = (0..s * FUTURE + t).fold(start.frames[i], |f, _| f.compose(&go));
                let check = |now: &[f32], first: &[f32], each: usize| {
                    for k in 0..each {
                        let (now, want) = (out.frames[i].point(point(now, k)), moved.point(point(first, k)));
                        assert!((now - want).length() < 2e-4, "step {s} person {i} frame {t} point {k}: {now} {want}");
                    }
                };
                let (row, first) = (i * FRAMES + t, i * SEED);
                check(&out.markers[row * MARKER_DIM..], &start.markers[first * MARKER_DIM..], MARKER_DIM / 3);
                check(&out.joints[row * JOINT_DIM..], &start.joints[first * JOINT_DIM..], JOINT_DIM / 3);
                let view = out.frames[i].dir(point(&out.views[3 * row..], 0));
                assert!((view - moved.dir(point(&start.views[3 * first..], 0))).length() < 1e-4);
            }
            // The new seed is the last two frames in their own canonical frame: the same points of the world.
            for k in 0..SEED * MARKER_DIM / 3 {
                let last = &out.markers[(i * FRAMES + FUTURE) * MARKER_DIM..];
                let seed = &people.markers[i * SEED * MARKER_DIM..];
                let apart = people.frames[i].point(point(seed, k)) - out.frames[i].point(point(last, k));
                assert!(apart.length() < 1e-5);
            }
            assert!(point(&people.joints[i * SEED * JOINT_DIM..], 0).truncate().length() < 1e-5);
        }
    }
}

#[test]
fn straight_walk_stays_straight() {
    // What lies between two bodies stands between them.
    [1, 3, 7, FUTURE].into_iter().for_each(|every| follows(Frame::planar(0.0, 0.0, 0.03), 6, every));
}

#[test]
fn circling_closes_the_circle() {
    follows(Frame::planar(0.04, 0.01, 0.03), 9, 1);
}

#[test]
fn threads_do_not_matter() {
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let (mut people, body, model) = walkers(13, Frame::planar(0.04, 0.01, 0.03));
        let sim = Sim::new(body, Arc::new(model));
        let mut out = Primitives::default();
        pool.install(|| (0..3).for_each(|_| sim.step(&mut people, &[0.0; 26], &mut out).unwrap()));
        (people, out.markers)
    };
    assert_eq!(run(1), run(3));
}

#[test]
fn seam_by_hand() {
    let mut params = vec![0.0; FRAMES * PARAMS];
    for (t, value) in [1.0, 2.0, 6.0, 4.0, 10.0].into_iter().enumerate() {
        params[t * PARAMS + 5] = value;
        params[t * PARAMS + 6] = value;
        params[t * PARAMS + 92] = -value;
    }
    smooth_seam(&mut params);
    let column = |k: usize| -> Vec<f32> { (0..5).map(|t| params[t * PARAMS + k]).collect() };
    assert_eq!(column(5), [1.0, 2.0, 6.0, 4.0, 10.0]);
    assert_eq!(column(6), [1.0, 2.0, 3.0, 8.0, 10.0]);
    assert_eq!(column(92), [-1.0, -2.0, -3.0, -8.0, -10.0]);
}

#[test]
fn markers_blend_half_and_half() {
    let (mut people, body, mut model) = walkers(1, Frame::planar(0.0, 0.0, 0.03));
    // The body found stands 10 cm above the predicted markers.
    model.params[2] += 0.1;
    let start = people.markers.clone();
    let mut out = Primitives::default();
    Sim::new(body, Arc::new(model)).step(&mut people, &[0.0; 2], &mut out).unwrap();
    assert_eq!(out.markers[..SEED * MARKER_DIM], start);
    for t in SEED..FRAMES {
        let z = out.markers[t * MARKER_DIM + 2];
        assert!((z - start[2] - 0.05).abs() < 1e-5, "{t}: {z}");
    }
}

#[test]
fn refuses_what_is_not_finite_or_does_not_fit() {
    let (mut people, body, mut model) = walkers(3, Frame::planar(0.0, 0.0, 0.03));
    model.broken = Some(FUTURE * MARKER_DIM + 5);
    let sim = Sim::new(body, Arc::new(model));
    let before = people.clone();
    let mut out = Primitives::default();
    let mut refuse = |people: &mut People, latents: &[f32], words: &str| {
        let error = sim.step(people, latents, &mut out).unwrap_err().to_string();
        assert!(error.contains(words), "{error}");
    };
    refuse(&mut people, &[0.0; 6], "predicted markers of person 1");
    refuse(&mut people, &[0.0, 0.0, 0.0, 0.0, f32::NAN, 0.0], "latents of person 2");
    refuse(&mut people, &[0.0; 5], "expected 3 x 2");
    assert_eq!(people, before);
    people.views.pop();
    refuse(&mut people, &[0.0; 6], "views of 3 people");
    assert!(sim.step_by(0, &mut people.select(&[]), &[], &mut out).is_err());
    let seed = SeedMotion { params: vec![0.0; PARAMS], betas: BETA };
    assert!(people.place(0, &toy(), &seed, 0.0, 0.0, 0.0).unwrap_err().to_string().contains("expected 2 x 93"));
}

#[test]
fn models_whose_frames_start_at_the_pelvis_give_the_same() {
    let go = Frame::planar(0.01, 0.002, 0.02);
    let (start, body, screw) = walkers(1, go);
    let height = start.pelvis_height(0);
    assert!((height - start.joints[2]).abs() < 1e-6 && height.abs() > 0.01);
    let lowered = Lowered(Screw::new(&body, &start, go), height);
    let run = |model: Arc<dyn MotionModel>| {
        let (mut people, mut out) = (start.clone(), Primitives::default());
        Sim::new(body.clone(), model).step(&mut people, &[0.0; 2], &mut out).unwrap();
        (people, out)
    };
    let ((a, x), (b, y)) = (run(Arc::new(screw)), run(Arc::new(lowered)));
    let near = |a: &[f32], b: &[f32]| a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5);
    assert!(near(&x.markers, &y.markers) && near(&x.params, &y.params) && near(&x.joints, &y.joints));
    assert!(near(&a.markers, &b.markers) && near(&a.params, &b.params));
}

#[test]
fn few_latents_go_to_the_most_active() {
    let (people, body, model) = walkers(1, Frame::IDENTITY);
    drop(people);
    let sim = Sim::new(body, Arc::new(model));
    // Two dimensions, in order.
    assert_eq!(sim.widen(&[3.0, 4.0], 1).unwrap(), [3.0, 0.0, 4.0, 0.0]);
    assert_eq!(sim.widen(&[3.0, 4.0], 2).unwrap(), [3.0, 4.0]);
    for k in [0, 3] {
        assert!(sim.widen(&[], k).unwrap_err().to_string().contains("has 2"));
    }
}

#[test]
fn the_shipped_models_active_dimensions_are_those_that_move() {
    let world = crate::sim::World::embedded().unwrap();
    let sim = &world.sim;
    let dim = sim.model().latent_dim();
    // How far markers go when one dimension alone is 2.
    let reach = |rank: usize| {
        let mut people = People::new(1);
        people.place(0, sim.body(), &world.train.seeds[0], 0.0, 0.0, 0.0).unwrap();
        let (mut still, mut moved) = (vec![0.0; FUTURE * MARKER_DIM], vec![0.0; FUTURE * MARKER_DIM]);
        let mut one = vec![0.0; dim];
        one[rank] = 2.0;
        let latent = sim.widen(&one, dim).unwrap();
        sim.model().decode(&people.markers, &vec![0.0; dim], &mut still).unwrap();
        sim.model().decode(&people.markers, &latent, &mut moved).unwrap();
        still.iter().zip(&moved).map(|(a, b)| (a - b).abs()).sum::<f32>() / still.len() as f32
    };
    let (first, last): (f32, f32) = ((0..4).map(reach).sum(), (dim - 40..dim).map(reach).sum());
    assert!(first / 4.0 > 10.0 * last / 40.0, "{first} {last}");
}

/// On a circle, with bodies found 10 cm above the prediction: between the seed's last frame and the first fitted one markers rise from the
/// prediction step by step, and in the plane they stay on its circle, whose chords come 5 mm nearer to the centre.
#[test]
fn markers_between_keep_to_the_prediction() {
    let go = Frame::planar(0.04, 0.01, 0.03);
    let (mut people, body, mut model) = walkers(1, go);
    model.params[2] += 0.1;
    let (start, pelvis) = (people.markers.clone(), people.joints[2]);
    let mut out = Primitives::default();
    Sim::new(body, Arc::new(model)).step_by(6, &mut people, &[0.0; 2], &mut out).unwrap();
    let mut moved = go;
    for t in 1..FRAMES {
        let share = ((t as f32 - 1.0) / 6.0).min(1.0);
        for i in 0..MARKER_DIM / 3 {
            let want = moved.point(point(&start, i)) + 0.05 * share * Vec3::Z;
            let now = point(&out.markers[t * MARKER_DIM..], i);
            assert!((now - want).length() < 2e-4, "marker {i} of frame {t}: {now}, expected {want}");
        }
        let rise = out.joints[t * JOINT_DIM + 2] - pelvis;
        assert!((rise - 0.1 * share).abs() < 1e-5, "pelvis of frame {t}: {rise}");
        moved = moved.compose(&go);
    }
}

#[test]
fn bodies_between_by_hand() {
    assert_eq!(Sim::fitted(1), (0..18).collect::<Vec<_>>());
    assert_eq!(Sim::fitted(3), [2, 5, 8, 11, 14, 16, 17]);
    assert_eq!(Sim::fitted(18), [16, 17]);
    let mut params = vec![0.0; 4 * PARAMS];
    let (turn, wrap, hand) = (ORIENT.start, POSE.start, HANDS.start);
    let (first, last) = params.split_at_mut(3 * PARAMS);
    last[TRANSL].copy_from_slice(&[0.3, -0.6, 0.9]);
    last[hand] = 1.5;
    last[turn + 2] = 0.3;
    // Half a turn less 0.03 one way is near half a turn less 0.03 the other way.
    let near = std::f32::consts::PI - 0.03;
    (first[wrap], last[wrap]) = (near, -near);
    bodies_between(&mut params);
    for k in 1..3 {
        let (frame, share) = (&params[k * PARAMS..], k as f32);
        let close = |i: usize, want: f32| assert!((frame[i] - want).abs() < 1e-3, "entry {i} of frame {k}: {} {want}", frame[i]);
        [0.1, -0.2, 0.3].into_iter().enumerate().for_each(|(i, v)| close(TRANSL.start + i, share * v));
        close(hand, 0.5 * share);
        close(turn + 2, 0.1 * share);
        close(wrap, near + 0.02 * share);
    }
}
