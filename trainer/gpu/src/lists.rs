//! Forked parts of a program as lists of tasks that one launch runs: `kernels/lists.c` walks them on a GPU.
//!
//! Each list belongs to one cluster of blocks, which meet after every phase of their list. The first list never waits for the second; where
//! the second needs what the first has done, it waits until that has reached a number.

use std::collections::{BTreeMap, VecDeque};
use std::ops::Range;

use crate::machine::Kernel;
use crate::program::{Command, Finished, Item, Lane, Pointer};

/// Kernels that may be tasks, numbered as `perform` in `kernels/lists.c` has them.
pub const LISTED: [Kernel; 13] = [
    Kernel::CopyRows,
    Kernel::Zero,
    Kernel::Carry,
    Kernel::CarryBackward,
    Kernel::ProductListed,
    Kernel::NormForward,
    Kernel::NormBackward,
    Kernel::CellForward,
    Kernel::CellBackward,
    Kernel::Draw,
    Kernel::DrawBackward,
    Kernel::InteractionForward,
    Kernel::InteractionBackward,
];
/// The largest weight, in numbers, of a fork that lists do better than launches: two clusters multiply by less of a GPU than all of it.
/// Measured on an H100 and an H200: with 98,000 (`small`) an update is a tenth faster by lists, with 393,000 (`paper`) not.
const LISTED_WEIGHT_MAX: usize = 200_000;

/// The kernel that does in a list what this one does by a launch.
fn listed(kernel: Kernel) -> Option<Kernel> {
    let here = if kernel == Kernel::ProductFewRows { Kernel::ProductListed } else { kernel };
    LISTED.contains(&here).then_some(here)
}

/// Warps of a block.
pub const WARPS: usize = 16;

/// A kernel by some of a cluster's blocks.
#[derive(Debug, Clone, PartialEq)]
pub struct Task {
    /// Which.
    pub kernel: Kernel,
    /// Which blocks of the cluster do it.
    pub blocks: Range<usize>,
    /// Addresses.
    pub p: Vec<Pointer>,
    /// Counts.
    pub n: Vec<i32>,
    /// Factors.
    pub f: Vec<f32>,
}

/// What a cluster does between two meetings.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Phase {
    /// One after the other in blocks; none needs another.
    pub tasks: Vec<Task>,
    /// What the first list must have reached before (0: nothing).
    pub wait: usize,
    /// What this list has reached after it (0: nothing new).
    pub reach: usize,
}

/// Commands between a fork and its join as lists.
#[derive(Debug, Clone, PartialEq)]
pub struct Lists {
    /// One list, or two of which the second waits for the first.
    pub lists: Vec<Vec<Phase>>,
    /// Blocks of a cluster.
    pub width: usize,
    /// Shared memory of a block.
    pub shared_bytes: usize,
    /// Where tasks, table, phases and control lie, once a machine has them.
    pub places: [u64; 4],
}

/// Makes lists, for clusters of `width` blocks, of the forked parts that consist of nothing but kernels that lists may have.
pub fn gather(finished: &mut Finished, width: usize) {
    for range in std::mem::take(&mut finished.forked).into_iter().rev() {
        let items = &finished.items[range.clone()];
        let (Some(lists), Some(first)) = (lists_of(items, width), items.first()) else { continue };
        let shared_bytes = items.iter().map(shared_bytes).max().unwrap_or_default();
        let (part, lane) = (first.part, Lane::Main);
        let lists = Lists { lists, width, shared_bytes, places: [0; 4] };
        let item = Item { part, lane, command: Command::Lists(Box::new(lists)) };
        finished.items.splice(range, [item]);
    }
}

/// Shared memory of a block that a command takes in a list.
#[must_use]
pub fn shared_bytes(item: &Item) -> usize {
    match &item.command {
        // x, at most 16 rows of it.
        Command::Kernel { kernel: Kernel::ProductFewRows, n, .. } => {
            4 * n[0].min(16) as usize * n[2] as usize
        }
        Command::Kernel { kernel, grid, .. } if listed(*kernel).is_some() => grid.shared_bytes,
        _ => 0,
    }
}

/// What a lane does, in its order.
enum Step<'a> {
    Do(&'a Command),
    /// It has come to this hand-over.
    Reach(usize),
    /// It goes on where another has come to this one.
    Wait(usize),
}

/// Which cluster runs a lane.
fn cluster(lane: Lane) -> usize {
    usize::from(lane == Lane::Side)
}

fn lists_of(items: &[Item], width: usize) -> Option<Vec<Vec<Phase>>> {
    // The launch itself is where a fork hands over first and last.
    let from = items.iter().take_while(|item| matches!(item.command, Command::HandOver(_))).count();
    let to = items.len()
        - items.iter().rev().take_while(|item| matches!(item.command, Command::HandOver(_))).count();
    let mut lanes: BTreeMap<usize, BTreeMap<Lane, VecDeque<Step<'_>>>> = BTreeMap::new();
    let mut directions: Vec<(usize, usize)> = Vec::new();
    let mut crossing = vec![false; items.len() + 1];
    for (at, item) in items.get(from..to)?.iter().enumerate() {
        let mut add = |lane: Lane, step| {
            lanes.entry(cluster(lane)).or_default().entry(lane).or_default().push_back(step);
        };
        match &item.command {
            Command::HandOver(to) => {
                // Numbered in the program's order, from 1 on.
                add(item.lane, Step::Reach(at + 1));
                add(*to, Step::Wait(at + 1));
                let direction = (cluster(item.lane), cluster(*to));
                crossing[at + 1] = direction.0 != direction.1;
                if crossing[at + 1] && !directions.contains(&direction) {
                    directions.push(direction);
                }
            }
            Command::Kernel { kernel: Kernel::ProductFewRows, n, .. }
                if n[1] as usize * n[2] as usize > LISTED_WEIGHT_MAX =>
            {
                return None;
            }
            Command::Kernel { kernel, .. } if listed(*kernel).is_some() => {
                add(item.lane, Step::Do(&item.command))
            }
            _ => return None,
        }
    }
    let order = match directions.as_slice() {
        [] | [(0, _)] => [0, 1],
        [(_, 0)] => [1, 0],
        _ => return None,
    };
    order
        .iter()
        .filter_map(|which| lanes.remove(which))
        .map(|lanes| phases_of(lanes, &crossing, width))
        .collect()
}

/// The phases of one cluster: each takes the next command of every lane that does not wait for another lane of the same phase.
fn phases_of(
    mut lanes: BTreeMap<Lane, VecDeque<Step<'_>>>,
    crossing: &[bool],
    width: usize,
) -> Option<Vec<Phase>> {
    let mut phases: Vec<Phase> = Vec::new();
    let mut reached = vec![false; crossing.len()];
    while lanes.values().any(|lane| !lane.is_empty()) {
        let mut wait = 0;
        let mut moved = true;
        while moved {
            moved = false;
            for lane in lanes.values_mut() {
                let goes_on = match lane.front() {
                    Some(Step::Reach(number)) => {
                        reached[*number] = true;
                        if crossing[*number] {
                            let last = phases.last_mut()?;
                            last.reach = last.reach.max(*number);
                        }
                        true
                    }
                    Some(Step::Wait(number)) if crossing[*number] => {
                        wait = wait.max(*number);
                        true
                    }
                    Some(Step::Wait(number)) => reached[*number],
                    Some(Step::Do(_)) | None => false,
                };
                if goes_on {
                    lane.pop_front();
                    moved = true;
                }
            }
        }
        let mut commands = Vec::new();
        for lane in lanes.values_mut() {
            if let Some(Step::Do(command)) = lane.front() {
                commands.push(*command);
                lane.pop_front();
            }
        }
        if commands.is_empty() {
            // Nothing but hand-overs was left, or the lanes wait for each other.
            if lanes.values().any(|lane| !lane.is_empty()) {
                return None;
            }
            break;
        }
        phases.push(Phase { tasks: share_out(&commands, width), wait, reach: 0 });
    }
    Some(phases)
}

/// Gives each command of a phase blocks by its work, at least one.
fn share_out(commands: &[&Command], width: usize) -> Vec<Task> {
    let work: Vec<usize> = commands.iter().map(|command| work_of(command)).collect();
    let total: usize = work.iter().sum();
    let spare = width - commands.len();
    let mut blocks: Vec<usize> = work.iter().map(|work| 1 + spare * work / total.max(1)).collect();
    let left = width - blocks.iter().sum::<usize>();
    if let Some(most) = (0..blocks.len()).max_by_key(|at| work[*at]) {
        blocks[most] += left;
    }
    let mut from = 0;
    let tasks = commands.iter().zip(blocks).filter_map(|(command, blocks)| {
        let Command::Kernel { kernel, p, n, f, .. } = command else { return None };
        let mut n = n.clone();
        fit(*kernel, &mut n, blocks);
        from += blocks;
        Some(Task { kernel: listed(*kernel)?, blocks: from - blocks..from, p: p.clone(), n, f: f.clone() })
    });
    tasks.collect()
}

/// Numbers of a weight that a product reads for 16 rows, or as many as take the time of another kernel, which is that of its functions and sums
/// over a row.
fn work_of(command: &Command) -> usize {
    let Command::Kernel { kernel, n, .. } = command else { return 0 };
    let n = |at: usize| n[at] as usize;
    match kernel {
        Kernel::ProductFewRows => n(0).div_ceil(16) * n(1) * n(2),
        Kernel::NormForward | Kernel::NormBackward => 8 * n(0) * n(1),
        Kernel::CellForward | Kernel::CellBackward => 64 * n(0) * n(1),
        Kernel::Draw | Kernel::DrawBackward => 8 * n(0) * n(1) * n(2),
        Kernel::Carry | Kernel::CarryBackward => 4 * n(0) * (n(1) + n(2)),
        Kernel::InteractionForward | Kernel::InteractionBackward => 256 * n(0) * n(1) * n(3),
        _ => 2 * n(0) * n(1),
    }
}

/// Sets what a kernel's arguments say about its threads to blocks of [`WARPS`] warps.
fn fit(kernel: Kernel, n: &mut [i32], blocks: usize) {
    match kernel {
        Kernel::ProductFewRows => {
            let [rows, columns, depth] = [n[0], n[1], n[2]].map(|n| n as usize);
            let fours = rows.div_ceil(16) * columns.div_ceil(4);
            let each = fours.div_ceil(blocks);
            // Warps that would have nothing share a product's depth, 128 numbers of it at least.
            let shares = (WARPS / each.min(WARPS)).min(depth.div_ceil(128)).max(1);
            n[7] = 1 << shares.ilog2();
            n[8] = i32::from(rows <= 16);
        }
        // A warp a row; of the cell, whose rows are wide, a block.
        Kernel::NormForward => n[5] = 0,
        Kernel::NormBackward => n[7] = 0,
        Kernel::CellForward => n[5] = 1,
        Kernel::CellBackward => n[6] = 1,
        _ => (),
    }
}

impl Lists {
    /// Words of the tasks' table: which task each block of a cluster has in each phase, list after list.
    #[must_use]
    pub fn table(&self) -> Vec<i32> {
        let mut table = Vec::new();
        let mut before = 0;
        for phase in self.lists.iter().flatten() {
            for (at, task) in phase.tasks.iter().enumerate() {
                table.extend(task.blocks.clone().map(|_| before + at as i32));
            }
            before += phase.tasks.len() as i32;
        }
        table
    }

    /// Waits and reaches of all phases, list after list.
    #[must_use]
    pub fn marks(&self) -> Vec<[i32; 2]> {
        self.lists.iter().flatten().map(|phase| [phase.wait as i32, phase.reach as i32]).collect()
    }

    /// All tasks, in the order that the table counts them in.
    pub fn tasks(&self) -> impl Iterator<Item = &Task> {
        self.lists.iter().flatten().flat_map(|phase| &phase.tasks)
    }
}
