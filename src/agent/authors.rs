//! The authors' policy, as its PyTorch checkpoint holds it, in this project's types.
//!
//! `checkpoint_N.pth` is {model, optim}, the model's tensors
//!
//! | theirs | ours |
//! |---|---|
//! | `shared_net.x_enc.*_l0`, `shared_net.ego_enc.*_l0` | `encoder.state.*_l0`, `encoder.egosensing.*_l0` |
//! | `actor.pnet.layers.B.layers.I`, `actor.pnet.out_fc` | `actor.B.I`, `actor.out` |
//! | `critic.vnet.layers.B.layers.I`, `critic.vnet.out_fc` | `critic.B.I`, `critic.out` |
//!
//! and the same again under `_actor_critic.`, which is not read. The networks are the same but for the order of an encoded scalar: theirs
//! is sin(2^0 x), cos(2^0 x), sin(2^1 x), ..., ours all sines and then all cosines. The trunk passes through residual blocks alone, so
//! putting rows and columns of their weights into our order gives the same function.

use super::{ObsGroup, ObsLayout, Part, PolicyConfig, PolicySpec};
use crate::io::Tensors;
use crate::motion::SEED;
use crate::{Error, Result, torch};
use std::path::Path;

/// Scalars of an observation.
const SCALARS: [&str; 2] = ["dist", "time"];

/// Sizes and flat parameters of the policy in the checkpoint `path`; sizes are those of its tensors.
///
/// # Errors
/// Names the file and the tensor that is missing or does not fit the others.
pub fn read_policy(path: impl AsRef<Path>) -> Result<(PolicySpec, Vec<f32>)> {
    let t = torch::read(path, |name| ["actor.pnet.", "critic.vnet.", "shared_net."].iter().any(|p| name.starts_with(p)))?;
    let spec = spec(&t)?;
    let order = order(&spec);
    let mut flat = Vec::new();
    for (i, d) in spec.layers.iter().enumerate() {
        let (mut weight, mut bias) = (t.f32s(&theirs(&d.weight), &[d.output, d.input])?, t.f32s(&theirs(&d.bias), &[d.output])?);
        let head = [&spec.actor, &spec.critic].into_iter().find_map(|head| head.iter().position(|&l| l == i));
        // Of a head's layers the even ones read the trunk (the output's number is even too), the odd ones write it.
        match head {
            Some(k) if k % 2 == 0 => weight = weight.chunks_exact(d.input).flat_map(|row| order.iter().map(|&o| row[o])).collect(),
            Some(_) => {
                weight = order.iter().flat_map(|&o| &weight[o * d.input..(o + 1) * d.input]).copied().collect();
                bias = order.iter().map(|&o| bias[o]).collect();
            }
            None => {}
        }
        flat.extend(weight);
        flat.extend(bias);
    }
    Ok((spec, flat))
}

/// The sizes that the tensors have.
fn spec(t: &Tensors) -> Result<PolicySpec> {
    let dims = |name: &str| -> Result<[usize; 2]> {
        let shape = t.shape(name)?;
        shape.as_slice().try_into().map_err(|_| Error::file(t.origin(), format!("tensor '{name}' has shape {shape:?}, expected two sizes")))
    };
    let names = t.names();
    let [[gates, width], [ego_gates, rays]] = [dims("shared_net.x_enc.weight_ih_l0")?, dims("shared_net.ego_enc.weight_ih_l0")?];
    let [outputs, trunk] = dims("actor.pnet.out_fc.weight")?;
    let encoded = trunk.saturating_sub(gates / 3 + ego_gates / 3);
    let octaves = encoded / (2 * SCALARS.len());
    if octaves == 0 || encoded != 2 * SCALARS.len() * octaves || outputs == 0 || outputs % 2 == 1 {
        let what = format!(
            "tensor 'actor.pnet.out_fc.weight' has shape [{outputs}, {trunk}], expected means and log variances of a latent over the states \
             of both GRUs ({} and {}) and the sines and cosines of two scalars",
            gates / 3,
            ego_gates / 3
        );
        return Err(Error::file(t.origin(), what));
    }
    let has = |b: &usize| names.contains(&format!("actor.pnet.layers.{b}.layers.0.weight"));
    let group = |name: &str, shape: &[usize]| ObsGroup { name: name.into(), shape: shape.into() };
    let mut groups = vec![group("state", &[SEED, width]), group("egosensing", &[SEED, rays])];
    groups.extend(SCALARS.map(|name| group(name, &[1])));
    let gru = [("state", gates / 3), ("egosensing", ego_gates / 3)].map(|(name, h)| (name.to_string(), h)).into();
    let config = PolicyConfig { gru, octaves, blocks: (0..).take_while(has).count(), ..PolicyConfig::default() };
    PolicySpec::new(config, ObsLayout::new(groups), outputs / 2).map_err(|e| Error::file(t.origin(), e.to_string()))
}

/// For each number of our trunk its place in theirs.
fn order(spec: &PolicySpec) -> Vec<usize> {
    let mut order = Vec::with_capacity(spec.encoded());
    for encoder in &spec.encoders {
        let (start, n) = (order.len(), encoder.output);
        match encoder.part {
            Part::Sine => order.extend((0..n).map(|i| start + 2 * (i % (n / 2)) + i / (n / 2))),
            _ => order.extend(start..start + n),
        }
    }
    order
}

/// Their name of our tensor `ours`.
fn theirs(ours: &str) -> String {
    let parts: Vec<&str> = ours.split('.').collect();
    match parts[..] {
        ["encoder", "state", gate] => format!("shared_net.x_enc.{gate}"),
        ["encoder", "egosensing", gate] => format!("shared_net.ego_enc.{gate}"),
        [head, "out", kind] => format!("{head}.{}.out_fc.{kind}", net(head)),
        [head, block, layer, kind] => format!("{head}.{}.layers.{block}.layers.{layer}.{kind}", net(head)),
        _ => ours.to_string(),
    }
}

fn net(head: &str) -> &str {
    if head == "actor" { "pnet" } else { "vnet" }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::PolicyEngine;

    fn file(name: &str) -> std::path::PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/assets").join(name)
    }

    #[test]
    fn the_policy_says_what_torch_says() {
        let (spec, flat) = read_policy(file("policy.pth")).unwrap();
        let groups: Vec<(&str, &[usize])> = spec.layout.groups.iter().map(|g| (g.name.as_str(), &g.shape[..])).collect();
        assert_eq!(groups, [("state", &[2, 402][..]), ("egosensing", &[2, 32]), ("dist", &[1]), ("time", &[1])]);
        assert_eq!((spec.config.octaves, spec.config.blocks, spec.config.gru["state"], spec.action.count()), (3, 2, 5, 3));
        let t = Tensors::read(file("expected.safetensors")).unwrap();
        let get = |name: &str, width: usize| t.f32s(&format!("policy.{name}"), &[3, width]).unwrap();
        let engine = PolicyEngine::new(&spec, &flat).unwrap();
        let mut out = vec![0.0; 3 * engine.output_dim()];
        engine.forward(&get("obs", spec.layout.dim()), &mut out).unwrap();
        let value = t.f32s("policy.value", &[3]).unwrap();
        for (i, row) in out.chunks_exact(7).enumerate() {
            let want = [&get("mu", 3)[3 * i..3 * i + 3], &get("logvar", 3)[3 * i..3 * i + 3], &value[i..=i]].concat();
            let worst = row.iter().zip(&want).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(worst < 1e-4, "person {i} is off by {worst}");
        }
    }

    #[test]
    fn scalars_are_put_into_our_order() {
        let (spec, _) = read_policy(file("policy.pth")).unwrap();
        // Two GRUs of 5, then sin 1, cos 1, sin 2, cos 2, sin 4, cos 4 of two scalars.
        let scalars = [0, 2, 4, 1, 3, 5].map(|k| 10 + k);
        let want: Vec<usize> = (0..10).chain(scalars).chain(scalars.map(|k| k + 6)).collect();
        assert_eq!(order(&spec), want);
    }

    #[test]
    fn other_checkpoints_are_refused() {
        let e = read_policy(file("regressor.ckp")).unwrap_err().to_string();
        assert!(e.contains("regressor.ckp") && e.contains("model_state_dict.pnet.in_fc"), "{e}");
    }
}
