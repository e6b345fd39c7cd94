//! All parameters in one flat array, and beside it their gradients, moments and average: one kernel moves them all.
//!
//! Every parameter begins at a multiple of 256 numbers. Convolutions lie as [a, 4, 4, b] where the trainer has [a, b, 4, 4], and a
//! posterior's columns for the embedding as (row, column, channel) where it has (channel, row, column): maps are channels-last here.

use std::collections::BTreeMap;
use std::ops::Range;

use crate::machine::{GpuError, Machine};
use crate::program::Matrix;

/// Numbers that a parameter's place is a multiple of.
pub const RUN: usize = 256;

/// What is trained by one optimiser, each a contiguous range of the array.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Group {
    /// World model with reward and continuation.
    World,
    Actor,
    Critic,
    /// The critic's slow copy, which lies as the critic does.
    SlowCritic,
}

impl Group {
    fn of(name: &str) -> Self {
        match name.split('.').next().unwrap_or_default() {
            "actor" => Self::Actor,
            "critic" => Self::Critic,
            "slow_critic" => Self::SlowCritic,
            _ => Self::World,
        }
    }
}

/// One parameter.
#[derive(Debug, Clone)]
pub struct Entry {
    /// Dotted name.
    pub name: String,
    /// Shape as the trainer has it.
    pub shape: Vec<usize>,
    /// Its optimiser.
    pub group: Group,
    /// Where it begins in every array, in numbers.
    pub offset: usize,
}

impl Entry {
    #[must_use]
    pub fn numbers(&self) -> usize {
        self.shape.iter().product()
    }

    /// How this parameter lies here.
    fn order(&self) -> Order {
        match *self.shape.as_slice() {
            [_, b, 4, 4] => Order::Last { inner: b },
            [_, columns] if self.name.ends_with("posterior.dense.linear.weight") => {
                Order::Embedding { columns }
            }
            _ => Order::Same,
        }
    }
}

enum Order {
    Same,
    /// [.., inner, 16] becomes [.., 16, inner].
    Last {
        inner: usize,
    },
    /// The last columns of each row, in the same way; how many, the model's sizes say.
    Embedding {
        columns: usize,
    },
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Array {
    /// The parameters.
    Values,
    /// Their gradients.
    Gradients,
    /// Averages of the gradients.
    First,
    /// Averages of their squares.
    Second,
    /// Running average of the parameters.
    Average,
}

/// The arrays of all parameters.
#[derive(Debug)]
pub struct Weights {
    entries: Vec<Entry>,
    by_name: BTreeMap<String, usize>,
    ranges: BTreeMap<Group, Range<usize>>,
    arrays: [u64; 5],
    owners: u64,
    bins: Matrix,
    deter: usize,
}

impl Weights {
    /// Arrays for parameters of these names and shapes, and the two-hot bins; `deter` is the width of h, after which a posterior's columns for the embedding
    /// begin.
    ///
    /// # Errors
    /// [`GpuError::Memory`].
    pub fn new(
        machine: &mut Machine,
        specs: &[(String, Vec<usize>)],
        bins: &[f32],
        deter: usize,
    ) -> Result<Self, GpuError> {
        let mut specs: Vec<_> = specs.iter().map(|(name, shape)| (Group::of(name), name, shape)).collect();
        specs.sort_by_key(|(group, name, _)| (*group, (*name).clone()));
        let (mut entries, mut by_name, mut ranges) = (Vec::new(), BTreeMap::new(), BTreeMap::new());
        let mut owners: Vec<u32> = Vec::new();
        let mut end = 0;
        for (group, name, shape) in specs {
            let entry = Entry { name: name.clone(), shape: shape.clone(), group, offset: end };
            let from = end;
            end += entry.numbers().next_multiple_of(RUN);
            owners.resize(end / RUN, entries.len() as u32);
            ranges.entry(group).or_insert(from..end).end = end;
            by_name.insert(name.clone(), entries.len());
            entries.push(entry);
        }
        let mut arrays = [0; 5];
        for array in &mut arrays {
            *array = machine.allocate(4 * end)?;
        }
        let owners_at = machine.allocate_shared(4 * owners.len())?;
        machine.upload(owners_at, 0, &owners)?;
        let bins_at = machine.allocate_shared(4 * bins.len())?;
        machine.upload(bins_at, 0, bins)?;
        let bins = Matrix::fixed(bins_at, 1, bins.len());
        Ok(Self { entries, by_name, ranges, arrays, owners: owners_at, bins, deter })
    }

    /// Two-hot bins [1, count].
    #[must_use]
    pub fn bins(&self) -> Matrix {
        self.bins
    }

    /// All parameters, in the order of the arrays.
    #[must_use]
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// Where a group lies in every array.
    #[must_use]
    pub fn range(&self, group: Group) -> Range<usize> {
        self.ranges.get(&group).cloned().unwrap_or_default()
    }

    /// A group in one of the arrays, as one row.
    #[must_use]
    pub fn group(&self, array: Array, group: Group) -> Matrix {
        self.groups(array, (group, group))
    }

    /// Groups that lie one after the other, from the first to the last, as one row.
    #[must_use]
    pub fn groups(&self, array: Array, (first, last): (Group, Group)) -> Matrix {
        let range = self.range(first).start..self.range(last).end;
        Matrix::fixed(self.arrays[array as usize] + 4 * range.start as u64, 1, range.len())
    }

    /// Whose each run of 256 numbers of a group is (u32).
    #[must_use]
    pub fn owners(&self, group: Group) -> u64 {
        self.owners + 4 * (self.range(group).start / RUN) as u64
    }

    /// A parameter in one of the arrays: its first dimension by all others.
    ///
    /// # Panics
    /// If the model has none of this name; a programming error.
    #[must_use]
    pub fn matrix(&self, array: Array, name: &str) -> Matrix {
        let entry = self.by_name.get(name).map(|at| &self.entries[*at]);
        let entry = entry.unwrap_or_else(|| panic!("the model has no parameter {name}"));
        let (rows, cols) = match entry.shape.as_slice() {
            [] => (1, 1),
            [width] => (1, *width),
            [rows, rest @ ..] => (*rows, rest.iter().product()),
        };
        Matrix::fixed(self.arrays[array as usize] + 4 * entry.offset as u64, rows, cols)
    }

    /// Sets a parameter of a run in one of the arrays from numbers in the trainer's order.
    pub fn set(
        &self,
        machine: &mut Machine,
        (array, run): (Array, usize),
        entry: &Entry,
        values: &[f32],
    ) -> Result<(), GpuError> {
        let address = self.arrays[array as usize] + 4 * entry.offset as u64;
        let mut here = vec![0.0; values.len()];
        self.pairs(entry, |there, place| here[place] = values[there]);
        machine.upload(address, run, &here)
    }

    /// The numbers of a parameter of a run in one of the arrays, in the trainer's order.
    pub fn get(
        &self,
        machine: &mut Machine,
        (array, run): (Array, usize),
        entry: &Entry,
    ) -> Result<Vec<f32>, GpuError> {
        let mut here = vec![0.0; entry.numbers()];
        machine.download(self.arrays[array as usize] + 4 * entry.offset as u64, run, &mut here)?;
        let mut values = vec![0.0; here.len()];
        self.pairs(entry, |there, place| values[there] = here[place]);
        Ok(values)
    }

    /// Every number's place in the trainer's order and here.
    fn pairs(&self, entry: &Entry, mut look: impl FnMut(usize, usize)) {
        let numbers = entry.numbers();
        match entry.order() {
            Order::Same => (0..numbers).for_each(|at| look(at, at)),
            Order::Last { inner } => {
                for at in 0..numbers {
                    let (outer, b, tap) = (at / (16 * inner), at / 16 % inner, at % 16);
                    look(at, (outer * 16 + tap) * inner + b);
                }
            }
            Order::Embedding { columns } => {
                let channels = (columns - self.deter) / 16;
                for at in 0..numbers {
                    let (row, column) = (at / columns, at % columns);
                    let to = match column.checked_sub(self.deter) {
                        None => column,
                        Some(embed) => self.deter + embed % 16 * channels + embed / 16,
                    };
                    look(at, row * columns + to);
                }
            }
        }
    }
}
