//! The kernels compiled as C, one thread a block, block after block. For tests: nothing here is fast.

use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use super::{Args, Kernel, PartTime, Runs, begin};
use crate::commands::{Command, Finished, Lane, Product};

pub(super) type Function = unsafe extern "C" fn(Args, i32, i32);

pub(super) mod functions {
    use super::super::{Args, host_functions};

    unsafe extern "C" {
        host_functions!();
    }
}

/// Memory of the host.
#[derive(Debug, Default)]
pub struct Host {
    memory: Vec<Vec<u64>>,
    /// Whether the side lane comes as late as it may: what lanes compute does not depend on how they meet.
    side_late: bool,
}

impl Host {
    pub(super) fn with_side_late() -> Self {
        Self { side_late: true, ..Self::default() }
    }

    pub(super) fn allocate(&mut self, bytes: usize) -> u64 {
        let block = vec![0u64; bytes.div_ceil(8)];
        let address = block.as_ptr() as u64;
        self.memory.push(block);
        address
    }

    pub(super) fn allocated(&self) -> usize {
        self.memory.iter().map(|block| 8 * block.len()).sum()
    }

    fn check(&self, address: u64, bytes: usize) {
        let inside = |block: &Vec<u64>| {
            let begin = block.as_ptr() as u64;
            address >= begin && address + bytes as u64 <= begin + 8 * block.len() as u64
        };
        assert!(self.memory.iter().any(inside), "{bytes} bytes at {address:#x} are not this machine's");
    }

    pub(super) fn upload(&mut self, address: u64, bytes: &[u8]) {
        self.check(address, bytes.len());
        // SAFETY: the range lies in a block of this machine, which nothing else writes to meanwhile.
        unsafe { std::ptr::copy_nonoverlapping(bytes.as_ptr(), address as *mut u8, bytes.len()) }
    }

    pub(super) fn download(&self, address: u64, bytes: &mut [u8]) {
        self.check(address, bytes.len());
        // SAFETY: the range lies in a block of this machine, which nothing else writes to meanwhile.
        unsafe { std::ptr::copy_nonoverlapping(address as *const u8, bytes.as_mut_ptr(), bytes.len()) }
    }

    pub(super) fn run(&mut self, program: &Finished, runs: Runs<'_>) {
        let mut waiting = Vec::new();
        for item in &program.items {
            let side = item.lane == Lane::Side;
            if self.side_late && side && item.command != Command::HandOver {
                waiting.push(&item.command);
                continue;
            }
            if side {
                waiting.drain(..).for_each(|command| execute(command, runs));
            }
            execute(&item.command, runs);
        }
    }

    pub(super) fn time_parts(&mut self, program: &Finished, runs: Runs<'_>) -> Vec<PartTime> {
        let mut times: Vec<PartTime> =
            program.parts.iter().map(|part| PartTime { part, commands: 0, ms: 0.0, flops: 0.0 }).collect();
        for item in &program.items {
            let start = Instant::now();
            execute(&item.command, runs);
            let time = &mut times[usize::from(item.part)];
            time.ms += 1e3 * start.elapsed().as_secs_f64();
            time.commands += 1;
            time.flops += runs.count as f64 * flops(&item.command);
        }
        times
    }
}

/// Operations of a matrix product; kernels count as none.
pub(super) fn flops(command: &Command) -> f64 {
    match command {
        Command::Kernel { .. } | Command::HandOver => 0.0,
        Command::Product(product) => {
            let (m, n, k) = product.sizes();
            2.0 * m as f64 * n as f64 * k as f64
        }
    }
}

fn execute(command: &Command, runs: Runs<'_>) {
    match command {
        // Loops over numbers and rows take any number of blocks; where the blocks are what is counted, all of them run.
        Command::Kernel { kernel, grid, p, n, f } => {
            let args = Args::new(p, n, f, runs);
            (0..runs.count).for_each(|run| call(*kernel, args.of_run(run), grid.blocks));
        }
        Command::HandOver => (),
        Command::Product(product) => (0..runs.count).for_each(|run| multiply(product, run, runs)),
    }
}

/// The kernels' shared memory is one for all threads of the process.
static SHARED: Mutex<()> = Mutex::new(());

fn call(kernel: Kernel, args: Args, blocks: usize) {
    let _held = SHARED.lock().unwrap_or_else(PoisonError::into_inner);
    let function = super::on_host(kernel);
    for block in 0..blocks as i32 {
        // SAFETY: the arguments are those that the kernel's description names, and its buffers are as large as its counts say.
        unsafe { function(args, block, blocks as i32) }
    }
}

fn multiply(p: &Product, run: usize, runs: Runs<'_>) {
    let (m, n, k) = p.sizes();
    let begin = |matrix| begin(matrix) + (run * runs.apart(begin(matrix))) as u64;
    let strides = |stride: usize, transposed: bool| {
        let (row, column) = if transposed { (1, stride) } else { (stride, 1) };
        (row as isize, column as isize)
    };
    let ((a_row, a_column), (b_row, b_column)) =
        (strides(p.a.stride, p.a_transposed), strides(p.b.stride, p.b_transposed));
    // SAFETY: the matrices' sizes were checked when the product was added, and they lie in this machine's memory.
    unsafe {
        gemm::gemm(
            m,
            n,
            k,
            begin(p.c) as *mut f32,
            1,
            p.c.stride as isize,
            p.add,
            begin(p.a) as *const f32,
            a_column,
            a_row,
            begin(p.b) as *const f32,
            b_column,
            b_row,
            1.0,
            1.0,
            false,
            false,
            false,
            gemm::Parallelism::None,
        );
    }
}
