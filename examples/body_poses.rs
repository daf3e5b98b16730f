//! Draws the body with its 67 markers in several poses, from the front and from the side.
//!
//!     cargo run --release --example body_poses -- docs/src/images/body.png

use egogen::body::rotation::{from_axis_angle, to_axis_angle};
use egogen::body::{BETAS, BodyModel, FOOT_MARKERS, MARKER_DIM, ORIENT, PARAMS, POSE, TRANSL, joint};
use egogen::render::{Camera, Canvas, Mesh, Shading, Stage, colour, tile};
use egogen::{Error, Result};
use glam::{Mat3, Vec2, Vec3};
use std::f32::consts::FRAC_PI_2;

/// Metres between two bodies.
const STEP: f32 = 1.75;

const L_SHOULDER: usize = 16;
const R_SHOULDER: usize = 17;
const L_ELBOW: usize = 18;
const R_ELBOW: usize = 19;

/// A pose: its name and the rotation of some joints, axis-angle in the body's rest frame (x left, y up, z forward).
type Pose = (&'static str, Vec<(usize, Vec3)>);

fn main() -> Result<()> {
    let path = std::env::args().nth(1).ok_or_else(|| Error::invalid("usage: body_poses OUT.png"))?;
    let model = BodyModel::load("checkpoints/body/body.safetensors")?;
    let poses = poses();
    let camera = camera(poses.len())?;
    let rows = [0.0, FRAC_PI_2].map(|yaw| Canvas { image: row(&model, &poses, yaw).render(&camera) });
    let rows = rows.map(|mut canvas| {
        for (i, (name, _)) in poses.iter().enumerate() {
            if let Some((at, _)) = camera.project(place(i, poses.len()) - Vec3::Y) {
                canvas.text(at - Vec2::new(20.0, 0.0), name, 2, colour::INK);
            }
        }
        canvas.image
    });
    tile(&rows, 1).write_png(path)
}

fn poses() -> Vec<Pose> {
    let arms_down = |l: f32, r: f32| vec![(L_SHOULDER, Vec3::new(0.0, 0.0, -l)), (R_SHOULDER, Vec3::new(0.0, 0.0, r))];
    let mut stride = vec![
        (joint::L_HIP, Vec3::new(-0.5, 0.0, 0.0)),
        (joint::L_KNEE, Vec3::new(0.12, 0.0, 0.0)),
        (joint::R_HIP, Vec3::new(0.3, 0.0, 0.0)),
        (joint::R_KNEE, Vec3::new(0.35, 0.0, 0.0)),
        (joint::R_FOOT, Vec3::new(-0.4, 0.0, 0.0)),
        (L_ELBOW, Vec3::new(0.0, -0.3, 0.0)),
        (R_ELBOW, Vec3::new(0.0, 0.5, 0.0)),
    ];
    // The arms hang and swing against the legs: first down, then about x.
    let swing = |side: f32, about_x: f32| to_axis_angle(&(Mat3::from_rotation_x(about_x) * Mat3::from_rotation_z(-side * 1.25)));
    stride.extend([(L_SHOULDER, swing(1.0, 0.4)), (R_SHOULDER, swing(-1.0, -0.4))]);
    let mut seated = arms_down(1.2, 1.2);
    for hip in [joint::L_HIP, joint::R_HIP] {
        seated.push((hip, Vec3::new(-1.45, 0.0, 0.0)));
    }
    for knee in [joint::L_KNEE, joint::R_KNEE] {
        seated.push((knee, Vec3::new(1.5, 0.0, 0.0)));
    }
    seated.extend([(L_ELBOW, Vec3::new(0.0, -1.2, 0.0)), (R_ELBOW, Vec3::new(0.0, 1.2, 0.0))]);
    let mut bent = arms_down(1.25, 1.25);
    bent.extend([3, 6, 9].map(|spine| (spine, Vec3::new(0.35, 0.0, 0.0))));
    bent.extend([(joint::L_KNEE, Vec3::new(0.3, 0.0, 0.0)), (joint::R_KNEE, Vec3::new(0.3, 0.0, 0.0))]);
    bent.push((joint::HEAD, Vec3::new(0.0, 0.7, 0.0)));
    vec![
        ("T-pose", vec![]),
        ("stand", arms_down(1.25, 1.25)),
        ("stride", stride),
        ("sit", seated),
        ("arms up", arms_down(-1.3, -1.3)),
        ("bend", bent),
    ]
}

/// The poses side by side along x, each turned by `yaw` from facing the camera.
fn row(model: &BodyModel, poses: &[Pose], yaw: f32) -> Stage {
    let body = model.shape(&[0.0; BETAS]);
    let mut stage = Stage::new();
    let mut vertices = Vec::new();
    for (i, (_, turns)) in poses.iter().enumerate() {
        let mut params = [0.0; PARAMS];
        let upright = Mat3::from_rotation_z(yaw) * Mat3::from_rotation_x(FRAC_PI_2);
        params[ORIENT].copy_from_slice(&to_axis_angle(&upright).to_array());
        for &(joint, turn) in turns {
            let at = POSE.start + 3 * (joint - 1);
            let sum = from_axis_angle(turn) * from_axis_angle(Vec3::from_slice(&params[at..]));
            params[at..at + 3].copy_from_slice(&to_axis_angle(&sum).to_array());
        }
        model.skin(&body, &body.pose(&params), &mut vertices);
        let lowest = vertices.iter().map(|v| v.z).fold(f32::MAX, f32::min);
        params[TRANSL].copy_from_slice(&(place(i, poses.len()) - lowest * Vec3::Z).to_array());
        let posed = body.pose(&params);
        model.skin(&body, &posed, &mut vertices);
        stage.add(&Mesh { vertices: vertices.clone(), faces: model.faces().to_vec() }, colour::SKIN, Shading::Smooth);
        let mut markers = [0.0; MARKER_DIM];
        body.markers(&posed, &mut markers);
        for (k, m) in markers.chunks_exact(3).enumerate() {
            let paint = if FOOT_MARKERS.contains(&k) { colour::RED } else { colour::BLUE };
            stage.add(&Mesh::sphere(Vec3::from_slice(m), 0.014, 2), paint, Shading::Smooth);
        }
    }
    stage
}

/// Where the body of number `i` among `n` stands.
fn place(i: usize, n: usize) -> Vec3 {
    Vec3::new((i as f32 - 0.5 * (n - 1) as f32) * STEP, 0.0, 0.0)
}

fn camera(bodies: usize) -> Result<Camera> {
    let (eye, target) = (Vec3::new(0.0, -14.0, 1.9), Vec3::new(0.0, 0.0, 0.98));
    let size = Vec2::new(bodies as f32 * STEP, 2.6) * 150.0;
    Camera::look_at(eye, target, size.x as usize, size.y as usize, 2.0 * (1.3f32 / 14.0).atan())
}
