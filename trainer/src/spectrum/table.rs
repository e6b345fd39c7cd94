use candle_core::{DType, Device, Result, Tensor};
use serde::Serialize;

use super::{effective_rank, is_rank_one, singular_values};
use crate::model::parameters::Parameters;
use crate::ops;

/// A row below this share of the median row's norm is a dead unit.
const DEAD_NORM_SHARE: f64 = 1e-3;
/// Matrices with more dead units than this share of their rows are flagged.
const DEAD_SHARE_FLAGGED: f64 = 0.1;
/// Singular values that a summary shows.
const SHOWN: usize = 3;

/// What is wrong with a matrix.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Flag {
    /// All zeros: an output layer that starts at 0 and has not been trained.
    Zero,
    /// Of rank 1: see [`is_rank_one`].
    RankOne,
    /// More than a tenth of its rows are dead units.
    DeadUnits,
}

impl Flag {
    /// As the table shows it.
    #[must_use]
    pub fn label(self) -> &'static str {
        match self {
            Self::Zero => "all zero",
            Self::RankOne => "RANK 1",
            Self::DeadUnits => "dead units",
        }
    }
}

/// A weight matrix in numbers.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MatrixSummary {
    /// Name of the parameter.
    pub name: String,
    /// Its shape as it is stored.
    pub shape: Vec<usize>,
    /// Rows of the matrix: outputs.
    pub rows: usize,
    /// Columns of the matrix: inputs, for a convolution times the kernel's area.
    pub columns: usize,
    /// The largest singular values, three or as many as there are.
    pub singular_values: Vec<f64>,
    /// `exp` of the entropy of all singular values, each as a share of their sum.
    pub effective_rank: f64,
    /// Effective rank by the smaller side.
    pub rank_share: f64,
    /// Share of the rows that are dead units.
    pub dead_share: f64,
    /// Root of the sum of squares.
    pub norm: f64,
    /// What is wrong with it, if anything.
    pub flag: Option<Flag>,
}

/// Every weight matrix of the parameters, by name; gains, shifts, biases and initial states are none.
pub fn summarise(parameters: &Parameters) -> Result<Vec<MatrixSummary>> {
    let mut weights: Vec<(&str, Tensor)> = parameters
        .iter()
        .filter(|(name, var)| name.ends_with(".weight") && var.rank() >= 2)
        .map(|(name, var)| Ok((name, var.as_detached_tensor().to_device(&Device::Cpu)?)))
        .collect::<Result<_>>()?;
    // The largest first, so that no thread is left alone with one at the end.
    weights.sort_by_key(|(_, weight)| std::cmp::Reverse(weight.elem_count()));
    let summaries = ops::in_parallel(weights, |(name, weight)| MatrixSummary::of(name, &weight));
    let mut summaries = summaries.into_iter().collect::<Result<Vec<_>>>()?;
    summaries.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(summaries)
}

impl MatrixSummary {
    /// Of the parameter of this name: a linear layer [out, in], a convolution [out, in, 4, 4], or the decoder's transposed one [in, out, 4, 4].
    pub fn of(name: &str, weight: &Tensor) -> Result<Self> {
        let is_transposed = weight.rank() == 4 && name.starts_with("decoder.");
        let matrix = if is_transposed { weight.transpose(0, 1)? } else { weight.clone() };
        let matrix = matrix.flatten_from(1)?.to_dtype(DType::F64)?; // [out, rest]
        let (rows, columns) = matrix.dims2()?;
        let row_norms = matrix.sqr()?.sum(1)?.sqrt()?.to_vec1::<f64>()?;
        let mut singular_values = singular_values(&matrix)?;
        let effective_rank = effective_rank(&singular_values);
        let dead_share = dead_share(&row_norms);
        let flag = match singular_values.first() {
            None | Some(0.0) => Some(Flag::Zero),
            _ if is_rank_one(&singular_values) => Some(Flag::RankOne),
            _ => (dead_share > DEAD_SHARE_FLAGGED).then_some(Flag::DeadUnits),
        };
        singular_values.truncate(SHOWN);
        Ok(Self {
            name: name.to_owned(),
            shape: weight.dims().to_vec(),
            rows,
            columns,
            singular_values,
            effective_rank,
            rank_share: effective_rank / rows.min(columns) as f64,
            dead_share,
            norm: row_norms.iter().map(|norm| norm * norm).sum::<f64>().sqrt(),
            flag,
        })
    }
}

/// Share of the rows with these norms that are almost 0 beside the median row.
fn dead_share(norms: &[f64]) -> f64 {
    let mut sorted = norms.to_vec();
    sorted.sort_by(f64::total_cmp);
    let limit = DEAD_NORM_SHARE * sorted.get(norms.len() / 2).copied().unwrap_or(0.0);
    norms.iter().filter(|norm| **norm <= limit).count() as f64 / norms.len().max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::agent;
    use rcwm_models::settings::{ModelKind, ModelSettings, Preset};

    fn summary(name: &str, weight: &Tensor) -> MatrixSummary {
        MatrixSummary::of(name, weight).unwrap()
    }

    #[test]
    fn an_outer_product_is_flagged() {
        let column = Tensor::new(&[1f32, 2.0, 2.0], &Device::Cpu).unwrap().reshape((3, 1)).unwrap();
        let row = Tensor::new(&[0f32, 4.0, 3.0, 0.0], &Device::Cpu).unwrap().reshape((1, 4)).unwrap();
        let found = summary("w", &column.matmul(&row).unwrap());
        assert_eq!((found.rows, found.columns, found.flag), (3, 4, Some(Flag::RankOne)));
        assert!((found.singular_values[0] - 15.0).abs() < 1e-9 && (found.norm - 15.0).abs() < 1e-9);
        assert!((found.effective_rank - 1.0).abs() < 1e-5 && found.dead_share == 0.0);
    }

    #[test]
    fn rows_of_zeros_are_dead_units_and_a_matrix_of_zeros_is_said_to_be_one() {
        let weight = Tensor::new(&[[1f32, 0.0], [0.0, 1.0], [1e-5, 0.0], [0.0, 0.0]], &Device::Cpu).unwrap();
        let found = summary("w", &weight);
        assert_eq!((found.dead_share, found.flag), (0.25 + 0.25, Some(Flag::DeadUnits)));
        assert_eq!(summary("w", &weight.zeros_like().unwrap()).flag, Some(Flag::Zero));
    }

    #[test]
    fn rows_are_outputs_of_both_kinds_of_convolution() {
        let weight = Tensor::zeros((8, 3, 4, 4), DType::F32, &Device::Cpu).unwrap();
        let sides = |name| (summary(name, &weight).rows, summary(name, &weight).columns);
        assert_eq!(sides("encoder.shared.0.conv.weight"), (8, 48));
        assert_eq!(sides("decoder.robot.0.conv.weight"), (3, 128));
    }

    #[test]
    fn a_fresh_model_has_no_matrix_of_rank_one() {
        for kind in [ModelKind::Rcwm, ModelKind::Vanilla] {
            let parameters =
                agent::initialise(&ModelSettings::preset(Preset::Debug, kind), 1, &Device::Cpu).unwrap();
            for matrix in summarise(&parameters).unwrap() {
                let starts_at_0 = ["heads.reward.out.", "critic.out.", "slow_critic.out."];
                let zero = starts_at_0.iter().any(|part| matrix.name.starts_with(part));
                assert_eq!(matrix.flag, zero.then_some(Flag::Zero), "{matrix:?}");
            }
        }
    }
}
