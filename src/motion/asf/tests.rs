use super::*;
use std::path::PathBuf;

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/importers").join(name)
}

fn small() -> (String, String) {
    (fs::read_to_string(fixture("small.asf")).unwrap().replace('\r', ""), fs::read_to_string(fixture("small.amc")).unwrap())
}

fn parse(asf: &str, amc: &str) -> Result<SourceClip> {
    parse_amc(Path::new("bad.amc"), amc, &parse_asf(Path::new("bad.asf"), asf)?, "bad", None)
}

#[test]
fn acclaim_matches_an_independent_reader() {
    let want: Vec<Vec<[f32; 3]>> = serde_json::from_str(&fs::read_to_string(fixture("acclaim_joints.json")).unwrap()).unwrap();
    let skeleton = read_asf(fixture("small.asf")).unwrap();
    for file in ["small.amc", "radians.amc"] {
        let clip = read_amc(fixture(file), &skeleton, "small", None).unwrap();
        assert_eq!((clip.frames.len(), clip.fps), (want.len(), if file == "small.amc" { 120.0 } else { 60.0 }));
        for (frame, want) in clip.frames.iter().zip(&want) {
            for (j, p) in frame.joints().iter().enumerate() {
                assert!((*p - Vec3::from(want[j])).length() < 3e-5, "{file} joint {j}: {p} for {:?}", want[j]);
            }
        }
    }
}

#[test]
fn bad_files_name_the_place() {
    let (asf, amc) = small();
    let swap = |a: &str, b: &str| (asf.replacen(a, b, 1), amc.clone());
    let swap_amc = |a: &str, b: &str| (asf.clone(), amc.replacen(a, b, 1));
    for ((asf, amc), want) in [
        (swap("angle deg", "angle turns"), "'angle turns', expected 'angle deg' or 'angle rad'"),
        (swap("position 0 0 0", "position 0 1 0"), "'position 0 1 0', expected 0 0 0"),
        (swap("XYZ\n    dof", "XYY\n    dof"), "axis order 'XYY', expected the letters"),
        (swap("dof rx ry rz", "dof rx ry l"), "dof 'l', expected rx, ry or rz"),
        (swap("name lfemur", "name thigh"), "':hierarchy' names 'lfemur', which is no bone"),
        (swap("direction", "direction nan"), "'direction' has 4 numbers, expected 3"),
        (swap("    root lhipjoint", "    root rhipjoint lhipjoint"), "names 'rhipjoint', which is no bone or hangs on two"),
        (swap("    lhand lfingers\n", ""), "bone 'lfingers' is not in ':hierarchy'"),
        (swap("order TX", "order"), "'root' has 6 numbers, expected 5"),
        (swap_amc("lfemur", "thigh"), "'thigh' is no bone of the skeleton"),
        (swap_amc("\nltoes", "\nltoes nan\nltoes"), "'nan' is not a finite number"),
        (swap_amc("\nltoes", "\nltoes 1\nltoes"), "has bone 'ltoes' twice"),
        (swap_amc("\nhead", "\n2\nhead"), "frame 1 ends without bone"),
        (swap_amc(":DEGREES", ":SAMPLES-PER-SECOND 1"), "':SAMPLES-PER-SECOND' means 1 frames per second, expected 10 to 1000"),
        ((asf.clone(), ":DEGREES\n".into()), "holds no frame"),
        ((String::new(), amc.clone()), "has no ':root'"),
    ] {
        let message = parse(&asf, &amc).err().map(|e| e.to_string()).unwrap_or_default();
        assert!(message.contains(want) && message.starts_with("bad."), "{message} for {want}");
    }
}

/// The clip that the archive holds in both formats; its BVH has another rest pose and another length of legs.
#[test]
fn recorded_clip_agrees_with_its_bvh() {
    let shared = std::env::var("EGOGEN_MOCAP").unwrap_or_default();
    let dir = Path::new(&shared);
    if !dir.join("cmu_asfamc_02").is_dir() {
        println!("skipped: set EGOGEN_MOCAP to the folder mocap of the unpacked mocap-cmu archive");
        return;
    }
    let skeleton = read_asf(dir.join("cmu_asfamc_02/02.asf")).unwrap();
    let ours = read_amc(dir.join("cmu_asfamc_02/02_01.amc"), &skeleton, "02_01", None).unwrap();
    let theirs = super::super::bvh::read_bvh(dir.join("cmu_bvh/02_01.bvh"), "02_01").unwrap();
    assert_eq!(ours.frames.len(), theirs.frames.len());
    let (mut worst, mut sum) = ([0.0f32; 2], 0.0);
    for (a, b) in ours.frames.iter().zip(&theirs.frames) {
        let (a, b) = (a.joints(), b.joints());
        for (j, child) in [(2, 3), (3, 4), (8, 9), (9, 10), (21, 22), (22, 23), (30, 31), (31, 32)] {
            worst[0] = worst[0].max((a[child] - a[j]).angle_between(b[child] - b[j]).to_degrees());
        }
        let gaps = (1..CMU_JOINTS).map(|j| (a[j] - a[0]).distance(b[j] - b[0]));
        worst[1] = gaps.clone().fold(worst[1], f32::max);
        sum += gaps.sum::<f32>() / CMU_JOINTS as f32;
    }
    let mean = sum / ours.frames.len() as f32;
    println!("limbs at most {:.1} degrees apart; joints, seen from the root, {mean:.3} m, at most {:.3} m", worst[0], worst[1]);
    assert!(worst[0] < 10.0 && worst[1] < 0.12 && mean < 0.04);
}
