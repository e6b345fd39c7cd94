//! Where programs run.

mod host;
#[cfg(feature = "cuda")]
mod nvidia;

use std::collections::BTreeMap;

use crate::commands::{Buffer, Command, Finished, Matrix, Pointer};
pub use crate::kernel::Kernel;
use crate::kernel::each_kernel;

use host::Host;
#[cfg(feature = "cuda")]
use nvidia::Nvidia;

/// Why something did not run on a machine.
#[derive(Debug, thiserror::Error)]
pub enum GpuError {
    /// The driver, cuBLAS or NVRTC could not be loaded.
    #[error(
        "no NVIDIA GPU can be used: {0}; install its driver and CUDA 13 (cuBLAS and NVRTC), or leave --device out"
    )]
    Unavailable(String),
    /// This build has no GPU support.
    #[error(
        "this program was built without the feature `cuda`; build it with its default features, or leave --device out"
    )]
    NotBuilt,
    /// There is not enough memory.
    #[error("the GPU has no {bytes} bytes of memory left ({reason}); take a smaller batch")]
    Memory {
        /// What was asked for.
        bytes: usize,
        /// What the driver said.
        reason: String,
    },
    /// A call of the driver or a library failed.
    #[error("the GPU failed in {what}: {reason}")]
    Failed {
        /// What was called.
        what: &'static str,
        /// What it said.
        reason: String,
    },
    /// The settings ask for something that no program does.
    #[error("{0}")]
    Unsupported(String),
}

/// Precision of matrix products. Sums, weights and everything else stay f32.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Precision {
    /// f32 throughout.
    #[default]
    F32,
    /// Operands with 10 bits of mantissa (TF32) on the tensor cores.
    Tf32,
}

/// The host or a GPU, and the memory of the runs that learn there together: one program updates all of them at once.
#[derive(Debug)]
pub struct Machine {
    place: Place,
    runs: usize,
    /// Bytes from one run's memory to the next one's, by address; 0: the same for all.
    apart: BTreeMap<u64, usize>,
}

#[derive(Debug)]
enum Place {
    /// The kernels compiled as C.
    Host(Host),
    /// An NVIDIA GPU.
    #[cfg(feature = "cuda")]
    Nvidia(Box<Nvidia>),
}

/// A program ready to run on a machine.
#[derive(Debug)]
pub struct Ready {
    finished: Finished,
    #[cfg(feature = "cuda")]
    graph: Option<nvidia::Graph>,
}

/// How long a part of a program took.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PartTime {
    pub part: &'static str,
    pub commands: usize,
    /// Time on the device.
    pub ms: f64,
    /// Operations of its matrix products.
    pub flops: f64,
}

/// How long one kind of command takes.
#[derive(Debug, Clone, PartialEq)]
pub struct CommandTime {
    /// The part it belongs to.
    pub part: &'static str,
    /// The kernel with its grid, or the product with its sizes.
    pub name: String,
    /// How often it is in the program.
    pub count: usize,
    /// Time of one, repeated back to back.
    pub us: f64,
}

impl Machine {
    fn of(place: Place) -> Self {
        Self { place, runs: 1, apart: BTreeMap::new() }
    }

    #[must_use]
    pub fn host() -> Self {
        Self::of(Place::Host(Host::default()))
    }

    /// The host, which runs what may run in any order in another one than [`Machine::host`].
    #[must_use]
    pub fn host_with_side_late() -> Self {
        Self::of(Place::Host(Host::with_side_late()))
    }

    /// The GPU of this number.
    ///
    /// # Errors
    /// [`GpuError::Unavailable`], [`GpuError::NotBuilt`] or [`GpuError::Failed`].
    pub fn nvidia(ordinal: usize, precision: Precision) -> Result<Self, GpuError> {
        #[cfg(feature = "cuda")]
        return Ok(Self::of(Place::Nvidia(Box::new(Nvidia::new(ordinal, precision)?))));
        #[cfg(not(feature = "cuda"))]
        {
            let _ = (ordinal, precision);
            Err(GpuError::NotBuilt)
        }
    }

    /// The same machine for so many runs that learn together. A single run's memory is the first one's.
    #[must_use]
    pub fn for_runs(self, runs: usize) -> Self {
        assert!(self.apart.is_empty() && runs > 0, "runs are counted before memory is taken");
        Self { runs, ..self }
    }

    /// Runs that learn together.
    #[must_use]
    pub fn runs(&self) -> usize {
        self.runs
    }

    /// What it is, in words.
    #[must_use]
    pub fn name(&self) -> String {
        match &self.place {
            Place::Host(_) => "host".to_owned(),
            #[cfg(feature = "cuda")]
            Place::Nvidia(gpu) => gpu.name(),
        }
    }

    /// Memory of this many bytes for each run, all zero, until the machine is dropped; the first run's address.
    ///
    /// # Errors
    /// [`GpuError::Memory`].
    pub fn allocate(&mut self, bytes: usize) -> Result<u64, GpuError> {
        let apart = bytes.next_multiple_of(APART_UNIT);
        let address = self.take(apart * self.runs)?;
        self.apart.insert(address, if self.runs > 1 { apart } else { 0 });
        Ok(address)
    }

    /// The same, for all runs together.
    ///
    /// # Errors
    /// [`GpuError::Memory`].
    pub fn allocate_shared(&mut self, bytes: usize) -> Result<u64, GpuError> {
        let address = self.take(bytes)?;
        self.apart.insert(address, 0);
        Ok(address)
    }

    fn take(&mut self, bytes: usize) -> Result<u64, GpuError> {
        match &mut self.place {
            Place::Host(host) => Ok(host.allocate(bytes)),
            #[cfg(feature = "cuda")]
            Place::Nvidia(gpu) => gpu.allocate(bytes),
        }
    }

    /// Bytes allocated.
    #[must_use]
    pub fn allocated(&self) -> usize {
        match &self.place {
            Place::Host(host) => host.allocated(),
            #[cfg(feature = "cuda")]
            Place::Nvidia(gpu) => gpu.allocated(),
        }
    }

    /// Copies numbers to an address that [`Machine::allocate`] gave, in the memory of a run, after everything that was run before.
    pub fn upload<T: bytemuck::Pod>(
        &mut self,
        address: u64,
        run: usize,
        values: &[T],
    ) -> Result<(), GpuError> {
        let (address, bytes) = (self.of_run(address, run), bytemuck::cast_slice(values));
        match &mut self.place {
            Place::Host(host) => host.upload(address, bytes),
            #[cfg(feature = "cuda")]
            Place::Nvidia(gpu) => gpu.upload(address, bytes)?,
        }
        Ok(())
    }

    /// Copies numbers from an address in the memory of a run, after everything that was run before.
    pub fn download<T: bytemuck::Pod>(
        &mut self,
        address: u64,
        run: usize,
        values: &mut [T],
    ) -> Result<(), GpuError> {
        let (address, bytes) = (self.of_run(address, run), bytemuck::cast_slice_mut(values));
        match &mut self.place {
            Place::Host(host) => host.download(address, bytes),
            #[cfg(feature = "cuda")]
            Place::Nvidia(gpu) => gpu.download(address, bytes)?,
        }
        Ok(())
    }

    fn of_run(&self, address: u64, run: usize) -> u64 {
        assert!(run < self.runs, "run {run} of {}", self.runs);
        address + (run * apart_at(&self.apart, address)) as u64
    }

    /// Makes a program ready; on a GPU it is captured, so that its first run costs what every run does.
    pub fn prepare(&mut self, finished: Finished) -> Result<Ready, GpuError> {
        Ok(Ready {
            #[cfg(feature = "cuda")]
            graph: match &mut self.place {
                Place::Host(_) => None,
                Place::Nvidia(gpu) => {
                    gpu.capture(&finished, Runs { count: self.runs, apart: &self.apart })?
                }
            },
            finished,
        })
    }

    /// Runs a program; on a GPU it may be under way when this returns.
    pub fn run(&mut self, program: &Ready) -> Result<(), GpuError> {
        let runs = Runs { count: self.runs, apart: &self.apart };
        match &mut self.place {
            Place::Host(host) => host.run(&program.finished, runs),
            #[cfg(feature = "cuda")]
            Place::Nvidia(gpu) => gpu.run(program.graph.as_ref())?,
        }
        Ok(())
    }

    /// Runs a program command by command and says how long each part took.
    pub fn time_parts(&mut self, program: &Ready) -> Result<Vec<PartTime>, GpuError> {
        let runs = Runs { count: self.runs, apart: &self.apart };
        match &mut self.place {
            Place::Host(host) => Ok(host.time_parts(&program.finished, runs)),
            #[cfg(feature = "cuda")]
            Place::Nvidia(gpu) => gpu.time_parts(&program.finished, runs),
        }
    }

    /// How long each kind of command of a program takes by itself, the dearest first; nothing on the host.
    pub fn time_commands(&mut self, program: &Ready) -> Result<Vec<CommandTime>, GpuError> {
        match &mut self.place {
            Place::Host(_) => Ok(Vec::new()),
            #[cfg(feature = "cuda")]
            Place::Nvidia(gpu) => {
                gpu.time_commands(&program.finished, Runs { count: self.runs, apart: &self.apart })
            }
        }
    }
}

/// What kernels count the distance of two runs' memory in.
const APART_UNIT: usize = 256;

/// Where the runs that learn together have their memory.
#[derive(Debug, Clone, Copy)]
struct Runs<'a> {
    count: usize,
    apart: &'a BTreeMap<u64, usize>,
}

impl Runs<'_> {
    /// Bytes from a number of the first run to that of the next.
    fn apart(self, address: u64) -> usize {
        apart_at(self.apart, address)
    }
}

/// The distance of runs in the memory that an address lies in.
fn apart_at(apart: &BTreeMap<u64, usize>, address: u64) -> usize {
    apart.range(..=address).next_back().map_or(0, |(_, apart)| *apart)
}

impl Ready {
    /// Commands in it: kernels and matrix products.
    #[must_use]
    pub fn commands(&self) -> usize {
        self.finished.items.iter().filter(|item| item.command != Command::HandOver).count()
    }
}

macro_rules! host_kernels {
    ($($variant:ident $name:ident),* $(,)?) => {
        /// A kernel's function on the host.
        fn on_host(kernel: Kernel) -> host::Function {
            match kernel { $(Kernel::$variant => host::functions::$name),* }
        }

        macro_rules! host_functions { () => { $(pub fn $name(a: Args, block: i32, blocks: i32);)* } }
        pub(in crate::machine) use host_functions;
    };
}

each_kernel!(host_kernels);

/// Arguments as kernels take them; the same in `kernels/common.h`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default)]
pub(in crate::machine) struct Args {
    p: [u64; 16],
    apart: [u32; 16],
    n: [i32; 16],
    f: [f32; 8],
}

impl Args {
    fn new(p: &[Pointer], n: &[i32], f: &[f32], runs: Runs<'_>) -> Self {
        let mut args = Self::default();
        for ((to, apart), from) in args.p.iter_mut().zip(&mut args.apart).zip(p) {
            let Some(place) = from.place else { continue };
            *to = address(place) + from.bytes as u64;
            *apart = (runs.apart(*to) / APART_UNIT) as u32;
        }
        args.n[..n.len()].copy_from_slice(n);
        args.f[..f.len()].copy_from_slice(f);
        args
    }

    /// The arguments with the addresses of another run than the first.
    fn of_run(mut self, run: usize) -> Self {
        for (address, apart) in self.p.iter_mut().zip(self.apart) {
            *address += (APART_UNIT * run) as u64 * u64::from(apart);
        }
        self
    }
}

/// The address of a place in a finished program.
fn address(place: Buffer) -> u64 {
    match place {
        Buffer::Fixed(address) => address,
        Buffer::Transient(_) => unreachable!("a finished program has fixed places alone"),
    }
}

/// The address of a matrix's first number.
fn begin(matrix: Matrix) -> u64 {
    address(matrix.place) + 4 * matrix.offset as u64
}
