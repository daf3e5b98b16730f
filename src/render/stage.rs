//! Things set up for a picture, and their ray-cast preview.

use super::intersect::{Sheared, Tri};
use super::{Camera, Image, Mesh, Rgb};
use glam::{Vec2, Vec3, Vec3A};
use obvhs::cwbvh::{CwBvh, builder::build_cwbvh};
use obvhs::ray::{Ray, RayHit};
use rayon::prelude::*;

/// Direction to the sun, not normalised.
const SUN: Vec3 = Vec3::new(0.45, -0.6, 1.3);
/// Side of a floor tile, metres.
const TILE: f32 = 1.0;
/// Offsets of the four samples of a pixel: a rotated grid, so that upright and level edges get four levels.
const SAMPLES: [Vec2; 4] = [Vec2::new(0.375, 0.125), Vec2::new(0.875, 0.375), Vec2::new(0.125, 0.625), Vec2::new(0.625, 0.875)];

/// How the normals of a mesh are taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shading {
    /// One normal per triangle; for boxes.
    Flat,
    /// Normals interpolated between the vertices; for bodies and spheres.
    Smooth,
}

/// Coloured meshes on a tiled floor at z = 0 under a sky.
#[derive(Clone, Debug)]
pub struct Stage {
    tris: Vec<Tri>,
    /// Vertex normals of each triangle.
    normals: Vec<[Vec3; 3]>,
    /// Linear colour of each triangle.
    colours: Vec<Vec3>,
    /// Whether the floor is drawn.
    pub floor: bool,
}

impl Default for Stage {
    fn default() -> Self {
        Self { tris: Vec::new(), normals: Vec::new(), colours: Vec::new(), floor: true }
    }
}

/// What a ray meets first.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Distance in lengths of the ray's direction; the depth for a direction from [`Camera::direction`].
    pub t: f32,
    /// Number of the triangle, counted over all meshes in the order in which they were added; None for the floor.
    pub triangle: Option<usize>,
    /// Unit shading normal on the side that the ray comes from.
    pub normal: Vec3,
    /// Unit normal of the surface itself on the side that the ray comes from.
    pub face_normal: Vec3,
}

impl Stage {
    /// A floor with nothing on it.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a mesh of one colour.
    pub fn add(&mut self, mesh: &Mesh, colour: Rgb, shading: Shading) -> &mut Self {
        let vertex_normals = if shading == Shading::Smooth { mesh.normals() } else { Vec::new() };
        for &face in &mesh.faces {
            let corners @ [a, b, c] = face.map(|i| mesh.vertices[i as usize]);
            let flat = (b - a).cross(c - a).try_normalize().unwrap_or(Vec3::Z);
            self.tris.push(Tri(corners));
            self.normals.push(if shading == Shading::Smooth { face.map(|i| vertex_normals[i as usize]) } else { [flat; 3] });
            self.colours.push(linear(colour));
        }
        self
    }

    /// Builds the tree over the triangles.
    pub fn trace(&self) -> TracedStage<'_> {
        let params = obvhs::BvhBuildParams::medium_build();
        TracedStage { stage: self, bvh: build_cwbvh(&self.tris, params, &mut Default::default()) }
    }

    /// The picture that `camera` takes.
    pub fn render(&self, camera: &Camera) -> Image {
        self.trace().render(camera)
    }
}

/// A [`Stage`] with its bounding-volume tree.
pub struct TracedStage<'a> {
    stage: &'a Stage,
    bvh: CwBvh,
}

impl TracedStage<'_> {
    /// What the ray `origin + t * direction`, t > 0, meets first: a triangle from either side or the floor from above.
    pub fn cast(&self, origin: Vec3, direction: Vec3) -> Option<Hit> {
        let hit = self.cast_triangles(origin, direction);
        if self.stage.floor && origin.z > 0.0 && direction.z < 0.0 {
            let t = -origin.z / direction.z;
            if hit.is_none_or(|h| t < h.t) {
                return Some(Hit { t, triangle: None, normal: Vec3::Z, face_normal: Vec3::Z });
            }
        }
        hit
    }

    fn cast_triangles(&self, origin: Vec3, direction: Vec3) -> Option<Hit> {
        let sheared = Sheared::new(origin, direction);
        let mut found = RayHit::none();
        let ray = Ray::new_inf(Vec3A::from(origin), Vec3A::from(direction));
        self.bvh.ray_traverse(ray, &mut found, |_, id| match sheared.hit(&self.stage.tris[self.index(id)]) {
            Some((t, _)) if t > 0.0 => t,
            _ => f32::INFINITY,
        });
        if !found.t.is_finite() {
            return None;
        }
        let i = self.index(found.primitive_id as usize);
        let [a, b, c] = self.stage.tris[i].0;
        let (t, weights) = sheared.hit(&self.stage.tris[i])?;
        let [na, nb, nc] = self.stage.normals[i];
        let towards = |n: Vec3| if n.dot(direction) > 0.0 { -n } else { n };
        let face_normal = towards((b - a).cross(c - a).try_normalize().unwrap_or(Vec3::Z));
        let smooth = (na * weights.x + nb * weights.y + nc * weights.z).try_normalize().unwrap_or(face_normal);
        let normal = if smooth.dot(face_normal) < 0.0 { -smooth } else { smooth };
        Some(Hit { t, triangle: Some(i), normal, face_normal })
    }

    fn index(&self, id: usize) -> usize {
        self.bvh.primitive_indices[id] as usize
    }

    /// Whether nothing but the floor lies between `origin` and infinity along `direction`.
    fn open(&self, origin: Vec3, direction: Vec3) -> bool {
        let sheared = Sheared::new(origin, direction);
        let ray = Ray::new_inf(Vec3A::from(origin), Vec3A::from(direction));
        self.bvh.ray_traverse_miss(ray, |_, id| match sheared.hit(&self.stage.tris[self.index(id)]) {
            Some((t, _)) if t > 0.0 => t,
            _ => f32::INFINITY,
        })
    }

    /// Renders with four samples per pixel; rows are spread over the cores, and the result does not depend on their number.
    pub fn render(&self, camera: &Camera) -> Image {
        let mut image = Image::filled(camera.width, camera.height, [0; 3]);
        image.rgb.par_chunks_mut((camera.width * 3).max(1)).enumerate().for_each(|(y, row)| {
            for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
                let corner = Vec2::new(x as f32, y as f32);
                let sum: Vec3 = (0..SAMPLES.len()).map(|k| self.colour(camera, corner + SAMPLES[k], k)).sum();
                pixel.copy_from_slice(&encode(sum / SAMPLES.len() as f32));
            }
        });
        image
    }

    /// Linear colour at image position `uv` for the sample of number `k`.
    fn colour(&self, camera: &Camera, uv: Vec2, k: usize) -> Vec3 {
        let direction = camera.direction(uv);
        let Some(hit) = self.cast(camera.eye(), direction) else { return sky(direction) };
        let point = camera.eye() + hit.t * direction;
        let base = match hit.triangle {
            Some(i) => self.stage.colours[i],
            None => tiles(point.truncate(), hit.t / camera.focal.y),
        };
        let colour = base * self.light(point, &hit, direction, k);
        match hit.triangle {
            Some(_) => colour,
            None => colour.lerp(sky(direction), (hit.t / 60.0).clamp(0.0, 1.0)),
        }
    }

    /// Light at a point: a hemisphere of sky, a little from the eye, and the sun with its shadow.
    fn light(&self, point: Vec3, hit: &Hit, direction: Vec3, k: usize) -> Vec3 {
        let sky = 0.26 + 0.16 * hit.normal.z;
        let eye = 0.14 * hit.normal.dot(-direction.normalize()).max(0.0);
        // Every sample of a pixel looks at another spot of the sun, which softens the shadow's edge.
        let spot = (SAMPLES[k] - 0.5) * 0.06;
        let sun = (SUN.normalize() + Vec3::new(spot.x, spot.y, 0.0)).normalize();
        let facing = if hit.face_normal.dot(sun) > 0.0 { hit.normal.dot(sun).max(0.0) } else { 0.0 };
        let start = point + hit.face_normal * 1e-4 * (1.0 + point.abs().max_element());
        let direct = if facing > 0.0 && self.open(start, sun) { 0.62 * facing } else { 0.0 };
        Vec3::new(0.97, 1.0, 1.05) * sky + Vec3::splat(eye) + Vec3::new(1.04, 1.0, 0.93) * direct
    }
}

fn sky(direction: Vec3) -> Vec3 {
    let up = (direction.normalize().z * 1.6).clamp(0.0, 1.0);
    Vec3::new(0.86, 0.89, 0.93).lerp(Vec3::new(0.55, 0.68, 0.86), up)
}

/// The floor's colour at `p`; `pixel` is the width of a pixel there, over which far tiles melt into their mean.
fn tiles(p: Vec2, pixel: f32) -> Vec3 {
    let cell = (p / TILE).floor();
    let sign = if (cell.x + cell.y).rem_euclid(2.0) < 1.0 { 1.0 } else { -1.0 };
    let clear = (1.0 - 12.0 * pixel / TILE).clamp(0.0, 1.0);
    Vec3::new(0.64, 0.64, 0.62) * (1.0 + 0.11 * sign * clear)
}

fn linear(colour: Rgb) -> Vec3 {
    Vec3::from(colour.map(|v| (v as f32 / 255.0).powf(2.2)))
}

/// A linear colour in eight bits a channel.
pub(super) fn encode(linear: Vec3) -> Rgb {
    linear.to_array().map(|v| (v.clamp(0.0, 1.0).powf(1.0 / 2.2) * 255.0).round() as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bare() -> Stage {
        Stage { floor: false, ..Stage::new() }
    }

    #[test]
    fn depth_of_a_box_by_hand() {
        let mut stage = Stage::new();
        stage.add(&Mesh::cuboid(Vec2::new(0.0, 3.0), Vec2::new(1.0, 0.5), 0.0, 2.0), [255, 0, 0], Shading::Flat);
        let traced = stage.trace();
        let camera = Camera::look_at(Vec3::new(0.0, -5.0, 1.0), Vec3::new(0.0, 0.0, 1.0), 640, 480, 2.0 * 0.5f32.atan()).unwrap();
        // Its near side stands at y = 2.5: 7.5 m ahead, at every pixel that sees it.
        for uv in [Vec2::new(320.0, 240.0), Vec2::new(370.0, 200.0)] {
            let hit = traced.cast(camera.eye(), camera.direction(uv)).unwrap();
            assert!((hit.t - 7.5).abs() < 1e-4 && (hit.normal - Vec3::NEG_Y).length() < 1e-5);
        }
        // Row 400 is 160 / 480 down per metre ahead: the floor, 1 m down, is met at 3 m.
        let hit = traced.cast(camera.eye(), camera.direction(Vec2::new(100.0, 400.0))).unwrap();
        assert!(hit.triangle.is_none() && (hit.t - 3.0).abs() < 1e-4);
        assert!(traced.cast(camera.eye(), camera.direction(Vec2::new(320.0, 10.0))).is_none());
    }

    #[test]
    fn depth_of_a_sphere() {
        let mut stage = bare();
        stage.add(&Mesh::sphere(Vec3::new(0.0, 0.0, 1.0), 0.5, 5), [0, 255, 0], Shading::Smooth);
        let traced = stage.trace();
        // A ray at height 0.3 over the centre enters at sqrt(0.25 - 0.09) = 0.4 from its middle.
        let hit = traced.cast(Vec3::new(-3.0, 0.0, 1.3), Vec3::X).unwrap();
        assert!((hit.t - 2.6).abs() < 1e-3, "{}", hit.t);
        assert!((hit.normal - Vec3::new(-0.8, 0.0, 0.6)).length() < 5e-3);
        assert!(traced.cast(Vec3::new(-3.0, 0.0, 1.51), Vec3::X).is_none());
    }

    #[test]
    fn no_ray_leaves_a_closed_mesh() {
        let sphere = Mesh::sphere(Vec3::new(0.3, -0.2, 0.9), 0.7, 4);
        let mut stage = bare();
        stage.add(&sphere, [0; 3], Shading::Smooth);
        let traced = stage.trace();
        let eye = Vec3::new(0.41, -0.13, 1.02);
        // Aimed exactly at every vertex and at the middle of every edge, where simple tests leak.
        let edges = sphere.faces.iter().flat_map(|f| (0..3).map(|k| [f[k] as usize, f[(k + 1) % 3] as usize]));
        let middles = edges.map(|[a, b]| 0.5 * (sphere.vertices[a] + sphere.vertices[b]));
        let leaks = sphere.vertices.iter().copied().chain(middles).filter(|&p| traced.cast(eye, p - eye).is_none()).count();
        assert_eq!(leaks, 0);
    }

    #[test]
    fn pixels_show_what_is_there() {
        let mut stage = Stage::new();
        stage.add(&Mesh::cuboid(Vec2::ZERO, Vec2::splat(0.5), 0.3, 1.0), [220, 30, 30], Shading::Flat);
        stage.add(&Mesh::sphere(Vec3::new(2.0, 0.0, 0.5), 0.5, 3), [30, 60, 220], Shading::Smooth);
        let camera = Camera::look_at(Vec3::new(1.0, -8.0, 3.0), Vec3::new(1.0, 0.0, 0.5), 160, 120, 0.7).unwrap();
        let image = stage.render(&camera);
        let at = |p: Vec3| {
            let (uv, _) = camera.project(p).unwrap();
            image.pixel(uv.x as usize, uv.y as usize).map(|v| v as i32)
        };
        let [r, g, b] = at(Vec3::new(0.0, -0.5, 0.5));
        assert!(r > 2 * g && r > 2 * b, "box {r} {g} {b}");
        let [r, g, b] = at(Vec3::new(2.0, -0.5, 0.5));
        assert!(b > 2 * r && b > g, "sphere {r} {g} {b}");
        let [r, g, b] = at(Vec3::new(-1.0, -2.0, 0.0));
        assert!(r.abs_diff(g) < 12 && g.abs_diff(b) < 12, "floor {r} {g} {b}");
        // The sun stands at +x, -y: the shadow of the box falls to -x, +y.
        let lit: i32 = at(Vec3::new(-1.8, -1.5, 0.0)).iter().sum();
        let dark: i32 = at(Vec3::new(-0.75, 0.5, 0.0)).iter().sum();
        assert!(dark < lit - 60, "shadow {dark} {lit}");
    }

    #[test]
    fn an_empty_stage_is_floor_and_sky() {
        let camera = Camera::look_at(Vec3::new(0.0, 0.0, 1.0), Vec3::new(1.0, 0.0, 1.0), 8, 8, 1.0).unwrap();
        let image = Stage::new().render(&camera);
        assert!(image.pixel(4, 0)[2] > image.pixel(4, 0)[0]);
        assert!(bare().trace().cast(Vec3::Z, Vec3::NEG_Z).is_none());
    }
}
