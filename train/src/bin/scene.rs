//! Makes scene bundles of meshes, procedural rooms and others' files, and shows them.

use clap::{Args, Parser, Subcommand, ValueEnum};
use egogen::io::write_atomic;
use egogen::render::{Image, ScenePlan, tile};
use egogen::scene::{
    Grid, MakeOptions, MeshOptions, Navigator, PICTURE, PairOptions, RoomKind, Rooms, SceneBundle, SceneFiles, Up, WalkableOptions,
    write_pairs,
};
use egogen_train::program::{self, Given};
use egogen_train::{Error, Result};
use indicatif::{ProgressBar, ProgressStyle};
use std::path::PathBuf;
use std::process::ExitCode;

/// Pairs whose ways the picture shows.
const SHOWN: usize = 5;
/// Side of the cells by which the walkable area is told, metres, and how many there may be; beyond them cells are larger.
const CELL: f64 = 0.02;
const CELLS: f64 = 4e6;

/// Scenes as folders: walkable polygon, mesh, cells, signed distances, pairs of start and goal, and a picture.
#[derive(Parser)]
#[command(
    name = "scene",
    version,
    after_help = "Examples:
  scene room --kind furnished --seed 7 --difficulty 0.8 --out scenes/room7     a procedural room
  scene mesh scan.ply --out scenes/scan                                       where people can walk in a mesh
  scene import --polygon room0.wkt --sdf room0_sdf.pkl --pairs room0_samples.pkl --out scenes/room0
  scene show scenes/room7                                                     what a bundle holds
  scene export scenes/room7 --authors-sdf room7_sdf.pkl --pairs room7.npy     for other programs
  scene gallery --out rooms.png                                               twelve rooms in one picture"
)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// A mesh (.glb, .gltf, .obj, .ply): finds its floor and where people can walk
    Mesh(OfMesh),
    /// A procedural room
    Room(OfRoom),
    /// Files of others: walkable polygon (JSON, WKT), navigation mesh, signed distances (.npz, .pkl), pairs (.npy, .pkl)
    Import(OfFiles),
    /// Prints what a bundle holds
    Show {
        /// Folder of the bundle
        dir: PathBuf,
    },
    /// Writes files for other programs from a bundle
    Export(Export),
    /// Draws rooms of every kind and difficulty side by side
    Gallery {
        /// PNG file
        #[arg(long, value_name = "FILE")]
        out: PathBuf,
        /// Seed of the first room
        #[arg(long, default_value_t = 0)]
        seed: u64,
        /// Width of one room's picture, pixels
        #[arg(long, default_value_t = 420)]
        width: usize,
    },
}

#[derive(Args)]
struct Common {
    /// Folder of the bundle: new, empty, or a bundle to replace
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Pairs of start and goal to draw
    #[arg(long, value_name = "N", default_value_t = PairOptions::default().count)]
    pairs_count: usize,
    /// Share of pairs whose straight line is blocked
    #[arg(long, value_name = "SHARE", default_value_t = PairOptions::default().blocked)]
    blocked: f32,
    /// Distance of starts, goals and ways from borders, metres
    #[arg(long, value_name = "M", default_value_t = PairOptions::default().clearance)]
    clearance: f32,
    /// Seed of the room and of the pairs
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

#[derive(Args)]
struct Distances {
    /// Voxels of the signed distances, metres; 0 for none
    #[arg(long, value_name = "M", default_value_t = MakeOptions::default().voxel)]
    voxel: f32,
}

#[derive(Args)]
struct OfMesh {
    file: PathBuf,
    /// The axis that points up: x, -x, y, -y, z or -z [default: y in glTF and OBJ, z in PLY]
    #[arg(long, value_name = "AXIS", value_parser = up, allow_hyphen_values = true)]
    up: Option<Up>,
    /// Metres per unit of the file [default: 1 in glTF, else told by the size]
    #[arg(long, value_name = "M")]
    unit: Option<f32>,
    /// Height of the floor, metres [default: the lowest large flat surface]
    #[arg(long, value_name = "M", allow_hyphen_values = true)]
    floor: Option<f32>,
    #[command(flatten)]
    distances: Distances,
    #[command(flatten)]
    common: Common,
}

#[derive(Args)]
struct OfRoom {
    #[arg(long, value_enum, default_value = "furnished")]
    kind: Kind,
    /// From 0, little in the way, to 1
    #[arg(long, default_value_t = Rooms::default().difficulty)]
    difficulty: f32,
    #[command(flatten)]
    distances: Distances,
    #[command(flatten)]
    common: Common,
}

#[derive(Args)]
struct OfFiles {
    /// Walkable polygon: JSON rings, GeoJSON or WKT
    #[arg(long, value_name = "FILE")]
    polygon: Option<PathBuf>,
    /// Navigation mesh, metres, z up
    #[arg(long, value_name = "FILE")]
    navmesh: Option<PathBuf>,
    /// Signed distances
    #[arg(long, value_name = "FILE")]
    sdf: Option<PathBuf>,
    /// Starts and goals, (n, 2, 2) or (n, 2, 3); else they are drawn
    #[arg(long, value_name = "FILE", conflicts_with_all = ["pairs_count", "blocked", "seed"])]
    pairs: Option<PathBuf>,
    /// Height of the floor, metres [default: the navigation mesh's, else 0]
    #[arg(long, value_name = "M", allow_hyphen_values = true)]
    floor: Option<f32>,
    #[command(flatten)]
    common: Common,
}

#[derive(Args)]
struct Export {
    /// Folder of the bundle
    dir: PathBuf,
    /// Signed distances as .npz: voxels, their side and the lowest centre
    #[arg(long, value_name = "FILE")]
    sdf: Option<PathBuf>,
    /// Signed distances as the authors' code reads them, .pkl or .npz: a cube, negative in free space
    #[arg(long, value_name = "FILE")]
    authors_sdf: Option<PathBuf>,
    /// Starts and goals as .npy, (n, 2, 2)
    #[arg(long, value_name = "FILE", required_unless_present_any = ["sdf", "authors_sdf"])]
    pairs: Option<PathBuf>,
}

#[derive(Clone, Copy, ValueEnum)]
enum Kind {
    Furnished,
    Box,
    Corridor,
    Hall,
}

impl From<Kind> for RoomKind {
    fn from(kind: Kind) -> Self {
        match kind {
            Kind::Furnished => Self::Furnished,
            Kind::Box => Self::Box,
            Kind::Corridor => Self::Corridor,
            Kind::Hall => Self::Hall,
        }
    }
}

fn up(text: &str) -> std::result::Result<Up, String> {
    serde_json::from_value(text.into()).map_err(|_| "expected x, -x, y, -y, z or -z".into())
}

fn main() -> ExitCode {
    program::exit(run(Cli::parse().command))
}

fn run(command: Command) -> Result<u8> {
    match command {
        Command::Mesh(args) => {
            let reading = MeshOptions { up: args.up, unit: args.unit };
            let options = args.common.options(args.floor, args.distances.voxel);
            args.common.make(5, |stages| SceneBundle::of_file(&args.file, &reading, &options, stages))
        }
        Command::Room(args) => {
            let room = Rooms { kind: args.kind.into(), difficulty: args.difficulty }.draw(args.common.seed).given()?;
            let options = args.common.options(None, args.distances.voxel);
            args.common.make(3, |stages| Ok((SceneBundle::of_room(room, &options, stages)?, Vec::new())))
        }
        Command::Import(args) => {
            let name = args.common.out.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
            let files = SceneFiles { polygon: args.polygon, navmesh: args.navmesh, sdf: args.sdf, pairs: args.pairs };
            let options = args.common.options(args.floor, 0.0);
            args.common.make(3, |stages| SceneBundle::of_files(name, &files, &options, stages))
        }
        Command::Show { dir } => {
            print!("{}", summary(&SceneBundle::read(&dir).given()?)?);
            Ok(0)
        }
        Command::Export(args) => {
            export(&args)?;
            Ok(0)
        }
        Command::Gallery { out, seed, width } => {
            write_atomic(&out, &gallery(seed, width)?.png()?)?;
            eprintln!("12 rooms drawn in {}", out.display());
            Ok(0)
        }
    }
}

impl Common {
    fn options(&self, floor: Option<f32>, voxel: f32) -> MakeOptions {
        let pairs = PairOptions { count: self.pairs_count, clearance: self.clearance, blocked: self.blocked, ..Default::default() };
        MakeOptions { walkable: WalkableOptions { floor, ..Default::default() }, voxel, pairs, seed: self.seed }
    }

    /// Makes a bundle, and warnings, under a bar over `stages` stages, draws and writes it.
    fn make(&self, stages: u64, work: impl FnOnce(&mut dyn FnMut(&str)) -> egogen::Result<(SceneBundle, Vec<String>)>) -> Result<u8> {
        SceneBundle::check_target(&self.out).given()?;
        let style = ProgressStyle::with_template("{wide_bar} {pos}/{len} {msg}").unwrap_or(ProgressStyle::default_bar());
        let bar = ProgressBar::new(stages).with_style(style);
        let mut next = |stage: &str| {
            bar.set_message(stage.to_string());
            bar.inc(1);
        };
        let (bundle, warnings) = work(&mut next).given()?;
        warnings.iter().for_each(|w| eprintln!("warning: {w}"));
        next("picture and files");
        bundle.write(&self.out, &picture(&bundle)?.png()?)?;
        bar.finish_and_clear();
        eprintln!("{}: {}", self.out.display(), PICTURE);
        print!("{}", summary(&bundle)?);
        Ok(0)
    }
}

/// Writes what is asked for of a bundle, which must have it.
fn export(args: &Export) -> Result<()> {
    let bundle = SceneBundle::read(&args.dir).given()?;
    let lacks = |what: &str| Error::config(format!("{}: the scene has no {what}", args.dir.display()));
    let sdf = || bundle.sdf.as_ref().ok_or_else(|| lacks("signed distances"));
    if let Some(path) = &args.sdf {
        sdf()?.write(path)?;
    }
    if let Some(path) = &args.authors_sdf {
        sdf()?.write_authors(path)?;
    }
    if let Some(path) = &args.pairs {
        if bundle.pairs.is_empty() {
            return Err(lacks("pairs"));
        }
        write_pairs(path, &bundle.pairs)?;
    }
    Ok(())
}

/// The plan of a bundle with the ways of its first pairs.
fn picture(bundle: &SceneBundle) -> Result<Image> {
    let navigator = Navigator::new(&bundle.walkable, bundle.clearance.into())?;
    let shown = bundle.pairs.iter().filter(|p| p.blocked).take(SHOWN);
    let ways: Vec<_> = shown.filter_map(|p| navigator.route(p.start.as_dvec2(), p.goal.as_dvec2())).map(|r| r.points).collect();
    let plan = ScenePlan { mesh: bundle.mesh.as_ref(), walkable: &bundle.walkable, ways: &ways, caption: &bundle.name };
    Ok(plan.draw(960)?)
}

/// What a bundle holds, a line each.
fn summary(bundle: &SceneBundle) -> Result<String> {
    let polygon = &bundle.walkable;
    let (low, high) = polygon.bounds();
    let size = high - low;
    let area = Grid::of_polygon_within(polygon, CELL, CELLS)?.area();
    let mut lines = vec![
        format!("scene      {}", bundle.name),
        format!("floor      z = {:.3} m", bundle.floor),
        format!("walkable   {area:.2} m2 within {:.2} x {:.2} m, {} holes", size.x, size.y, polygon.holes().len()),
    ];
    if let Some(mesh) = &bundle.mesh {
        lines.push(format!(
            "mesh       {} triangles, {} objects, {} materials",
            mesh.triangles.len(),
            mesh.objects.len(),
            mesh.materials.len()
        ));
    }
    if let Some(grid) = &bundle.blocked {
        lines.push(format!("cells      {} x {} of {} m", grid.dims[0], grid.dims[1], grid.cell));
    }
    if let Some(sdf) = &bundle.sdf {
        lines.push(format!("distances  {} x {} x {} voxels of {} m", sdf.dims[0], sdf.dims[1], sdf.dims[2], sdf.voxel));
    }
    if !bundle.pairs.is_empty() {
        let n = bundle.pairs.len() as f32;
        let straight = bundle.pairs.iter().map(|p| p.start.distance(p.goal)).sum::<f32>() / n;
        let blocked = bundle.pairs.iter().filter(|p| p.blocked).count() as f32 / n;
        let ways: Vec<f32> = bundle.pairs.iter().map(|p| p.way).filter(|&w| w > 0.0).collect();
        let way = ways.iter().sum::<f32>() / ways.len().max(1) as f32;
        let (percent, without) = (100.0 * blocked, bundle.pairs.len() - ways.len());
        lines
            .push(format!("pairs      {n}: {straight:.2} m straight, {way:.2} m to walk, {percent:.0} % blocked, {without} without a way"));
    }
    lines.extend(bundle.origin.iter().map(|(what, from)| format!("from       {what}: {from}")));
    Ok(lines.join("\n") + "\n")
}

/// Eight furnished rooms, two corridors and two halls of rising difficulty.
fn gallery(seed: u64, width: usize) -> Result<Image> {
    let draw = |k: u64| -> Result<Image> {
        let seed = seed.wrapping_add(k);
        let kind = match k {
            0..8 => RoomKind::Furnished,
            8 | 9 => RoomKind::Corridor,
            _ => RoomKind::Hall,
        };
        let room = Rooms { kind, difficulty: (k % 4) as f32 / 3.0 }.draw(seed)?;
        let navigator = Navigator::new(&room.walkable, PairOptions::default().clearance.into())?;
        let pairs = PairOptions { count: 3, blocked: 1.0, ..Default::default() }.draw(&navigator, seed)?;
        let routes = pairs.iter().filter_map(|p| navigator.route(p.start.as_dvec2(), p.goal.as_dvec2()));
        let ways: Vec<_> = routes.map(|r| r.points).collect();
        let plan = ScenePlan { mesh: Some(&room.mesh), walkable: &room.walkable, ways: &ways, caption: &room.name };
        Ok(plan.draw(width)?)
    };
    let images: Vec<Image> = (0..12).map(draw).collect::<Result<_>>()?;
    Ok(tile(&images, 4))
}
