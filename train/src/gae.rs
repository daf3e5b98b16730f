//! Generalised advantage estimation (Schulman et al. 2016), with terminations and truncations kept apart.

/// What one collection recorded, time outermost: entry t x envs + i.
pub struct Steps<'a> {
    pub envs: usize,
    pub reward: &'a [f32],
    /// Value of the observation acted on.
    pub value: &'a [f32],
    /// Value of the observation the step led to (before any reset); not read where `terminated`.
    pub next_value: &'a [f32],
    pub terminated: &'a [bool],
    pub truncated: &'a [bool],
}

/// Advantages and returns (advantage + value), in the order of the steps.
///
/// delta = r + gamma V' - V, with V' = 0 after a termination; A = delta + gamma lambda A', with A' = 0 after either end.
pub fn gae(steps: &Steps, gamma: f32, lambda: f32) -> (Vec<f32>, Vec<f32>) {
    let total = steps.reward.len();
    let mut advantage = vec![0.0; total];
    for k in (0..total).rev() {
        let bootstrap = if steps.terminated[k] { 0.0 } else { steps.next_value[k] };
        let goes_on = !steps.terminated[k] && !steps.truncated[k] && k + steps.envs < total;
        let later = if goes_on { advantage[k + steps.envs] } else { 0.0 };
        advantage[k] = steps.reward[k] + gamma * bootstrap - steps.value[k] + gamma * lambda * later;
    }
    let returns = advantage.iter().zip(steps.value).map(|(a, v)| a + v).collect();
    (advantage, returns)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn agrees_with_explicit_sums() {
        let t = crate::fixture();
        let get = |name: &str| t.f32s(&format!("gae.{name}"), &[9, 4]).unwrap();
        let flags = |name: &str| -> Vec<bool> { get(name).iter().map(|&x| x != 0.0).collect() };
        let (reward, value, next_value) = (get("reward"), get("value"), get("next_value"));
        let (terminated, truncated) = (flags("terminated"), flags("truncated"));
        assert!(terminated.contains(&true) && truncated.contains(&true));
        let steps =
            Steps { envs: 4, reward: &reward, value: &value, next_value: &next_value, terminated: &terminated, truncated: &truncated };
        let (advantage, returns) = gae(&steps, 0.93, 0.8);
        for (k, want) in get("advantage").iter().enumerate() {
            assert!((advantage[k] - want).abs() < 1e-5, "step {k}: {} against {want}", advantage[k]);
            assert!((returns[k] - want - value[k]).abs() < 1e-5);
        }
    }

    /// Every pattern of terminations and truncations over four steps, by Tianshou's `compute_episodic_return`.
    #[test]
    fn agrees_with_tianshou() {
        let t = crate::fixture();
        let get = |name: &str| t.f32s(&format!("tianshou.gae.{name}"), &[4, 81]).unwrap();
        let flags = |name: &str| -> Vec<bool> { get(name).iter().map(|&x| x != 0.0).collect() };
        let (reward, value, next_value) = (get("reward"), get("value"), get("next_value"));
        let (terminated, truncated) = (flags("terminated"), flags("truncated"));
        let steps =
            Steps { envs: 81, reward: &reward, value: &value, next_value: &next_value, terminated: &terminated, truncated: &truncated };
        let (advantage, returns) = gae(&steps, 0.93, 0.8);
        for (have, want) in advantage.iter().zip(get("advantage")).chain(returns.iter().zip(get("returns"))) {
            assert!((have - want).abs() < 1e-5, "{have} against {want}");
        }
    }

    /// gamma 0.5, lambda 0.5, values 1 and 2, rewards 1 and 1; the last step ends the episode in three ways.
    #[test]
    fn by_hand() {
        let last = |terminated: bool, truncated: bool| {
            let (ended, cut) = ([false, terminated], [false, truncated]);
            let steps =
                Steps { envs: 1, reward: &[1.0, 1.0], value: &[1.0, 2.0], next_value: &[2.0, 4.0], terminated: &ended, truncated: &cut };
            gae(&steps, 0.5, 0.5).0
        };
        // Terminated: delta = [1 + 1 - 1, 1 - 2], A = [1 - 0.25, -1].
        assert_eq!(last(true, false), [0.75, -1.0]);
        // Cut off, or the end of the collection: the last delta bootstraps, 1 + 2 - 2.
        assert_eq!(last(false, true), [1.25, 1.0]);
        assert_eq!(last(false, false), [1.25, 1.0]);
    }
}
