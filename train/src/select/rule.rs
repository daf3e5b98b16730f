//! The rule by which a policy is selected, on a table of what every candidate came to.

use super::SelectConfig;
use serde::{Deserialize, Serialize};

/// How natural bodies are.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Quality {
    /// Mean ||VP|| under the shipped pose prior (eq. 9).
    pub pose_norm: f64,
    /// Mean error of the distances between markers that ride on one bone, millimetres.
    pub bone_error_mm: f64,
}

/// A candidate after its test episodes.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tried {
    pub epoch: u64,
    /// Mean return.
    pub reward: f64,
    /// Whether each start's episode succeeded, where the environment has such a figure.
    pub success: Option<Vec<bool>>,
    /// The divergence from N(0, I) that the rule goes by; none for discrete actions.
    pub kl: Option<f64>,
    /// In the motion task alone.
    pub quality: Option<Quality>,
}

/// What the rule says of a table.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Verdict {
    /// Of every candidate, why it is not admitted; empty for those that are.
    pub reasons: Vec<Vec<String>>,
    /// Who is admitted, best first.
    pub ranking: Vec<usize>,
    /// Criteria left out, as they would have left nobody.
    pub left_out: Vec<&'static str>,
}

/// Criteria in the order in which they are given up.
const CRITERIA: [&str; 3] = ["pose quality", "success", "return"];

/// Admits candidates by return, success and pose quality, and ranks those by their divergence, then by epoch; where there is no
/// divergence, by return.
pub fn judge(tried: &[Tried], rule: &SelectConfig, prior: Option<Quality>) -> Verdict {
    let best_return = tried.iter().map(|t| t.reward).fold(f64::NEG_INFINITY, f64::max);
    let best_success = tried.iter().filter(|t| t.success.is_some()).reduce(|a, b| if rate(b) > rate(a) { b } else { a });
    let checks: Vec<[Option<String>; 3]> =
        tried.iter().map(|t| [quality(t, rule, prior), success(t, best_success, rule), returns(t, best_return, rule)]).collect();
    let mut verdict = Verdict::default();
    for first in 0..CRITERIA.len() {
        verdict.left_out = CRITERIA[..first].to_vec();
        verdict.reasons = checks.iter().map(|c| c[first..].iter().flatten().cloned().collect()).collect();
        if verdict.reasons.iter().any(Vec::is_empty) {
            break;
        }
    }
    verdict.ranking = (0..tried.len()).filter(|&i| verdict.reasons[i].is_empty()).collect();
    let cost = |i: usize| tried[i].kl.unwrap_or(-tried[i].reward);
    verdict.ranking.sort_by(|&a, &b| cost(a).total_cmp(&cost(b)).then(tried[a].epoch.cmp(&tried[b].epoch)));
    verdict
}

fn returns(t: &Tried, best: f64, rule: &SelectConfig) -> Option<String> {
    // Of a negative return a share would be a larger one.
    let least = best - (1.0 - rule.return_share) * best.abs();
    let admitted = t.reward >= least;
    (!admitted).then(|| format!("return {:.3} is below {least:.3}, {} of the best's {best:.3}", t.reward, rule.return_share))
}

fn success(t: &Tried, best: Option<&Tried>, rule: &SelectConfig) -> Option<String> {
    let (own, best) = (t.success.as_ref()?, best?);
    let [mean, error] = paired(best.success.as_ref()?, own);
    (mean > rule.success_errors * error).then(|| {
        let what = format!("success {:.3} is below the best's {:.3}", rate(t), rate(best));
        format!("{what} (epoch {}) by more than {} standard errors of the difference, {error:.4}", best.epoch, rule.success_errors)
    })
}

fn quality(t: &Tried, rule: &SelectConfig, prior: Option<Quality>) -> Option<String> {
    let (own, prior) = (t.quality?, prior?);
    let figures = [("||VP||", own.pose_norm, prior.pose_norm), ("bone error, mm,", own.bone_error_mm, prior.bone_error_mm)];
    let worse = figures.into_iter().find(|(_, own, prior)| *own > (1.0 + rule.quality) * prior);
    worse.map(|(name, own, prior)| format!("{name} {own:.2} is above the prior's {prior:.2} by more than {} of it", rule.quality))
}

/// Share of successes.
fn rate(t: &Tried) -> f64 {
    let all = t.success.as_deref().unwrap_or_default();
    all.iter().filter(|s| **s).count() as f64 / all.len().max(1) as f64
}

/// Mean of the differences a - b over the same starts, and its standard error.
fn paired(a: &[bool], b: &[bool]) -> [f64; 2] {
    let n = a.len() as f64;
    let all = || a.iter().zip(b).map(|(&a, &b)| f64::from(i8::from(a) - i8::from(b)));
    let mean = all().sum::<f64>() / n;
    let square = all().map(|d| (d - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
    [mean, (square / n).sqrt()]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 100 starts of which the first `hits` succeed.
    fn tried(epoch: u64, reward: f64, hits: usize, kl: f64, pose_norm: f64, bone_error_mm: f64) -> Tried {
        let success = Some((0..100).map(|i| i < hits).collect());
        Tried { epoch, reward, success, kl: Some(kl), quality: Some(Quality { pose_norm, bone_error_mm }) }
    }

    const PRIOR: Option<Quality> = Some(Quality { pose_norm: 5.0, bone_error_mm: 2.0 });

    fn winner(table: &[Tried]) -> u64 {
        table[judge(table, &SelectConfig::default(), PRIOR).ranking[0]].epoch
    }

    /// Each table differs from the first in the candidate of epoch 2, which one criterion after the other turns away.
    #[test]
    fn every_criterion_decides_once() {
        let good = tried(2, 9.81, 94, 0.10, 6.0, 2.4);
        let table = |second: Tried| vec![tried(1, 10.0, 95, 0.30, 5.0, 2.0), second, tried(3, 9.9, 95, 0.20, 5.0, 2.0)];
        assert_eq!(winner(&table(good.clone())), 2, "all borders are kept, and its divergence is the smallest");
        assert_eq!(winner(&table(Tried { reward: 9.79, ..good.clone() })), 3, "less than 98 % of 10");
        // 5 of 100 discordant starts: mean 0.05, standard error sqrt(0.05 x 0.95 / 99) = 0.0219, so 2.28 errors.
        assert_eq!(winner(&table(tried(2, 9.81, 90, 0.10, 6.0, 2.4))), 3, "success is lower by more than chance");
        // 3 of 100: 0.03 against 0.01714, 1.75 errors.
        assert_eq!(winner(&table(tried(2, 9.81, 92, 0.10, 6.0, 2.4))), 2, "chance explains it");
        assert_eq!(winner(&table(tried(2, 9.81, 94, 0.10, 6.01, 2.4))), 3, "poses are worse than the prior's by more than 20 %");
        assert_eq!(winner(&table(tried(2, 9.81, 94, 0.10, 6.0, 2.41))), 3, "bones are");
        assert_eq!(winner(&table(Tried { kl: Some(0.21), ..good.clone() })), 3, "another is nearer to the prior");
        assert_eq!(winner(&table(Tried { kl: Some(0.20), ..good })), 2, "as near, and earlier");
    }

    #[test]
    fn reasons_name_figures() {
        let table = [tried(1, 10.0, 95, 0.3, 5.0, 2.0), tried(2, 5.0, 50, 0.1, 9.0, 2.0)];
        let verdict = judge(&table, &SelectConfig::default(), PRIOR);
        assert_eq!((verdict.ranking, verdict.reasons[0].len()), (vec![0], 0));
        let all = verdict.reasons[1].join("; ");
        for word in
            ["return 5.000 is below 9.800", "success 0.500 is below the best's 0.950 (epoch 1)", "||VP|| 9.00 is above the prior's 5.00"]
        {
            assert!(all.contains(word), "{all}");
        }
    }

    #[test]
    fn pairs_count_not_rates() {
        // 50 of 100 each way: the same rates, and starts that differ all the time.
        let [mean, error] = paired(&[true, false].repeat(50), &[false, true].repeat(50));
        assert!(mean == 0.0 && (error - (100.0f64 / 99.0 / 100.0).sqrt()).abs() < 1e-12);
        assert_eq!(paired(&[true; 4], &[true; 4]), [0.0, 0.0]);
    }

    #[test]
    fn negative_returns_are_compared_too() {
        let with = |reward| Tried { epoch: 1, reward, ..Tried::default() };
        let verdict = judge(&[with(-100.0), with(-101.9), with(-102.1)], &SelectConfig::default(), None);
        assert_eq!(verdict.ranking, [0, 1], "without a divergence the larger return comes first");
    }

    #[test]
    fn criteria_that_leave_nobody_are_left_out() {
        let rule = SelectConfig::default();
        let ugly = [tried(1, 10.0, 95, 0.3, 9.0, 2.0), tried(2, 9.9, 95, 0.2, 9.0, 2.0), tried(3, 2.0, 95, 0.1, 9.0, 2.0)];
        let verdict = judge(&ugly, &rule, PRIOR);
        assert_eq!((verdict.left_out, verdict.ranking), (vec!["pose quality"], vec![1, 0]));
        assert!(verdict.reasons[1].is_empty() && verdict.reasons[2][0].contains("return"));
        // One has the return, the other the success.
        let split = [tried(1, 10.0, 50, 0.3, 5.0, 2.0), tried(2, 5.0, 95, 0.2, 5.0, 2.0)];
        let verdict = judge(&split, &rule, PRIOR);
        assert_eq!((verdict.left_out, verdict.ranking), (vec!["pose quality", "success"], vec![0]));
    }
}
