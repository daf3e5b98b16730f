//! What policies are compared on, as data.

use crate::{Error, Result};
use egogen::scene::CrowdedScenes;
use egogen_envs::motion::Order;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Name and text of the scenarios that ship.
const SHIPPED: [(&str, &str); 9] = [
    ("box", include_str!("../../scenarios/box.toml")),
    ("midpoint", include_str!("../../scenarios/midpoint.toml")),
    ("moving", include_str!("../../scenarios/moving.toml")),
    ("circle-2", include_str!("../../scenarios/circle-2.toml")),
    ("circle-4", include_str!("../../scenarios/circle-4.toml")),
    ("circle-8", include_str!("../../scenarios/circle-8.toml")),
    ("circle-16", include_str!("../../scenarios/circle-16.toml")),
    ("rooms", include_str!("../../scenarios/rooms.toml")),
    ("rooms-two", include_str!("../../scenarios/rooms-two.toml")),
];

/// Names of the scenarios that ship, in their order.
pub fn shipped() -> impl Iterator<Item = &'static str> {
    SHIPPED.iter().map(|s| s.0)
}

/// A set of scenes in which every policy has the same starts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scenario {
    /// That of the file.
    #[serde(default)]
    pub name: String,
    /// What happens, in one sentence.
    pub about: String,
    /// Scenes, each with starts of its own.
    pub scenes: usize,
    /// How often each scene is played, with other noise.
    #[serde(default = "once")]
    pub repeats: usize,
    /// Steps of 0.45 s after which an episode ends.
    #[serde(default = "eleven")]
    pub max_depth: u32,
    /// Whether a penetration (eq. 7) ends a person's episode.
    #[serde(default)]
    pub end_on_penetration: bool,
    /// Whose places people see.
    #[serde(default)]
    pub order: Order,
    #[serde(default)]
    pub people: Looks,
    pub layout: Layout,
}

fn once() -> usize {
    1
}

fn eleven() -> u32 {
    11
}

/// How people are at the start.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Looks {
    /// Turned away from the goal by up to this, degrees either way.
    pub turn_deg: f32,
    /// Whether all people of a scene are male-like or female-like, by the throw of a coin; otherwise of the mean build.
    pub builds: bool,
    /// Standard deviation that each shape coefficient differs by.
    pub shape: f32,
}

/// Where people walk.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Layout {
    /// The walking task's own scenes, people, starts and goals.
    Task,
    /// One person from (-distance/2, 0) to (distance/2, 0), a box of any turn between them, walls all round.
    Midpoint {
        /// Metres from start to goal.
        distance: f32,
        /// Least and greatest side of the box, metres.
        side: [f32; 2],
        /// Height of the box, metres.
        height: f32,
        /// Distance of the walls from the middle, metres.
        wall: f32,
        /// The box moves along the line x = 0; absent: it stands at the midpoint.
        #[serde(default)]
        moving: Option<Moving>,
    },
    /// People evenly round a circle; each goes to where the one opposite stands.
    Circle { people: usize, radius: f32, wall: f32 },
    /// Procedural rooms; two people swap places.
    Rooms { people: usize, rooms: CrowdedScenes },
    /// A scene bundle with pairs of start and goal; two people swap places. The path counts from the scenario's file.
    Bundle { people: usize, path: PathBuf },
}

/// How a box moves.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Moving {
    /// How far it goes to either side, metres.
    pub reach: f32,
    /// Slowest and fastest, metres per second.
    pub speed: [f32; 2],
}

impl Scenario {
    /// A scenario that ships, the file of one's own, or the folder of a scene bundle, in which 100 episodes of one person are played.
    ///
    /// Errors name the file and the key, and for unknown names those that ship.
    pub fn find(name: &str) -> Result<Self> {
        let path = Path::new(name);
        if let Some((_, text)) = SHIPPED.iter().find(|s| s.0 == name) {
            return Self::parse(name, path, text);
        }
        if path.is_dir() {
            let people = Looks { turn_deg: 36.0, ..Default::default() };
            let layout = Layout::Bundle { people: 1, path: path.into() };
            let about = format!("The scene bundle {name}, one person at a time");
            let (scenes, name) = (100, stem(path));
            let order = Order::default();
            let scenario = Self { name, about, scenes, repeats: 1, max_depth: 13, end_on_penetration: false, order, people, layout };
            return Ok(scenario);
        }
        if !path.is_file() {
            let known = shipped().collect::<Vec<_>>().join(", ");
            return Err(Error::config(format!("no scenario '{name}': expected {known}, a TOML file or a scene bundle")));
        }
        let text = std::fs::read_to_string(path).map_err(|e| Error::config(format!("{name}: {e}")))?;
        Self::parse(&stem(path), path, &text)
    }

    fn parse(name: &str, path: &Path, text: &str) -> Result<Self> {
        let bad = |e: String| Error::config(format!("scenario {}: {e}", path.display()));
        let mut scenario: Self = toml::from_str(text).map_err(|e| bad(e.to_string()))?;
        if scenario.name.is_empty() {
            scenario.name = name.into();
        }
        if let Layout::Bundle { path: bundle, .. } = &mut scenario.layout {
            *bundle = path.parent().unwrap_or(Path::new("")).join(&bundle);
        }
        scenario.check().map_err(bad)?;
        Ok(scenario)
    }

    /// People of a scene.
    pub fn people_per_scene(&self) -> usize {
        match self.layout {
            Layout::Task | Layout::Midpoint { .. } => 1,
            Layout::Circle { people, .. } | Layout::Rooms { people, .. } | Layout::Bundle { people, .. } => people,
        }
    }

    /// The same with so many scenes that there are at least `episodes` of a person; fewer, so that there are that many.
    pub fn with_episodes(self, episodes: usize) -> Self {
        let scenes = episodes.div_ceil(self.repeats * self.people_per_scene());
        Self { scenes, ..self }
    }

    fn check(&self) -> std::result::Result<(), String> {
        let need = |ok: bool, key: &str, right: &str| if ok { Ok(()) } else { Err(format!("{key}: expected {right}")) };
        let range = |r: [f32; 2]| r[0] > 0.0 && r[0] <= r[1] && r[1].is_finite();
        let positive = |x: f32| x > 0.0 && x.is_finite();
        need((1..=100_000).contains(&self.scenes), "scenes", "1 to 100000")?;
        need((1..=1000).contains(&self.repeats), "repeats", "1 to 1000")?;
        need((1..=1000).contains(&self.max_depth), "max_depth", "1 to 1000 steps")?;
        need((0.0..=180.0).contains(&self.people.turn_deg), "people.turn_deg", "0 to 180 degrees")?;
        need((0.0..=2.0).contains(&self.people.shape), "people.shape", "0 to 2")?;
        match &self.layout {
            Layout::Task => need(self.people == Looks::default() && self.repeats == 1, "people, repeats", "none with layout.kind = 'task'"),
            Layout::Midpoint { distance, side, height, wall, moving } => {
                need(range(*side), "layout.side", "[low, high] with 0 < low <= high")?;
                need(positive(*height), "layout.height", "more than 0")?;
                let reach = side[1] * std::f32::consts::FRAC_1_SQRT_2 + 0.4;
                need(*distance > 2.0 * reach, "layout.distance", &format!("more than {:.2} m, through the largest box", 2.0 * reach))?;
                let far = 0.5 * distance.max(moving.as_ref().map_or(0.0, |m| 2.0 * m.reach)) + 0.5;
                need(*wall > far && wall.is_finite(), "layout.wall", &format!("more than {far:.2} m"))?;
                let fits = moving.as_ref().is_none_or(|m| positive(m.reach) && range(m.speed));
                need(fits, "layout.moving", "reach above 0 and speed = [low, high] with 0 < low <= high")
            }
            Layout::Circle { people, radius, wall } => {
                need((2..=1000).contains(people), "layout.people", "2 to 1000")?;
                need(people.is_multiple_of(2), "layout.people", "an even number, so that each has one opposite")?;
                need(positive(*radius), "layout.radius", "more than 0")?;
                need(*wall > radius + 0.5 && wall.is_finite(), "layout.wall", "0.5 m more than the radius")
            }
            Layout::Rooms { people, rooms } => {
                need((1..=2).contains(people), "layout.people", "1 or 2")?;
                rooms.validate("layout.rooms").map_err(|e| e.to_string())
            }
            Layout::Bundle { people, .. } => need((1..=2).contains(people), "layout.people", "1 or 2"),
        }
    }
}

/// The last part of a path, without ending.
fn stem(path: &Path) -> String {
    path.file_stem().map_or("scenario".into(), |s| s.to_string_lossy().into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_ships_is_sound_and_large_enough() {
        for name in shipped() {
            let s = Scenario::find(name).unwrap();
            assert!(s.name == name && s.scenes * s.repeats * s.people_per_scene() >= 100, "{name}");
            assert_eq!(toml::from_str::<Scenario>(&toml::to_string(&s).unwrap()).unwrap(), s);
        }
    }

    #[test]
    fn mistakes_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("mine.toml");
        let told = |text: &str| {
            std::fs::write(&path, text).unwrap();
            Scenario::find(path.to_str().unwrap()).unwrap_err().to_string()
        };
        let circle = "about = 'x'\nscenes = 3\n[layout]\nkind = 'circle'\nradius = 2.0\nwall = 4.0\n";
        for (text, word) in [
            (circle.to_string(), "people"),
            (format!("{circle}people = 3"), "an even number"),
            (format!("{circle}people = 4\nsize = 3"), "size"),
            (format!("{circle}people = 4").replace("scenes = 3", "scenes = 0"), "scenes: expected 1"),
            (format!("{circle}people = 4").replace("4.0", "2.1"), "layout.wall"),
            ("about = 'x'\nscenes = 3\n[layout]\nkind = 'maze'".into(), "maze"),
        ] {
            let e = told(&text);
            assert!(e.contains(word) && e.contains("mine.toml"), "{word}: {e}");
        }
        let unknown = Scenario::find("circle-3").unwrap_err().to_string();
        assert!(unknown.contains("circle-3") && unknown.contains("circle-16"), "{unknown}");
    }

    #[test]
    fn bundles_are_found_beside_the_file() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("office.toml");
        std::fs::write(&path, "about = 'x'\nscenes = 3\n[layout]\nkind = 'bundle'\npeople = 2\npath = 'rooms/office'").unwrap();
        let s = Scenario::find(path.to_str().unwrap()).unwrap();
        assert_eq!((s.name.as_str(), s.people_per_scene(), s.clone().with_episodes(9).scenes), ("office", 2, 5));
        assert_eq!(s.layout, Layout::Bundle { people: 2, path: dir.path().join("rooms/office") });
        let folder = Scenario::find(dir.path().to_str().unwrap()).unwrap();
        assert!(matches!(folder.layout, Layout::Bundle { people: 1, .. }));
    }
}
