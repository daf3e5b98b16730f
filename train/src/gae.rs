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
