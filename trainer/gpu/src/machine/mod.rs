//! Where programs run.

mod host;
#[cfg(feature = "cuda")]
mod nvidia;

use crate::commands::{Buffer, Command, Finished, Matrix, Pointer};
pub use crate::kernel::Kernel;
use crate::kernel::each_kernel;

pub use host::Host;
#[cfg(feature = "cuda")]
pub use nvidia::Nvidia;

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

/// The host, or a GPU.
#[derive(Debug)]
pub enum Machine {
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
    #[must_use]
    pub fn host() -> Self {
        Self::Host(Host::default())
    }

    /// The host, which runs what may run in any order in another one than [`Machine::host`].
    #[must_use]
    pub fn host_with_side_late() -> Self {
        Self::Host(Host::with_side_late())
    }

    /// The GPU of this number.
    ///
    /// # Errors
    /// [`GpuError::Unavailable`], [`GpuError::NotBuilt`] or [`GpuError::Failed`].
    pub fn nvidia(ordinal: usize, precision: Precision) -> Result<Self, GpuError> {
        #[cfg(feature = "cuda")]
        return Ok(Self::Nvidia(Box::new(Nvidia::new(ordinal, precision)?)));
        #[cfg(not(feature = "cuda"))]
        {
            let _ = (ordinal, precision);
            Err(GpuError::NotBuilt)
        }
    }

    /// What it is, in words.
    #[must_use]
    pub fn name(&self) -> String {
        match self {
            Self::Host(_) => "host".to_owned(),
            #[cfg(feature = "cuda")]
            Self::Nvidia(gpu) => gpu.name(),
        }
    }

    /// Memory of this many bytes, all zero, until the machine is dropped.
    ///
    /// # Errors
    /// [`GpuError::Memory`].
    pub fn allocate(&mut self, bytes: usize) -> Result<u64, GpuError> {
        match self {
            Self::Host(host) => Ok(host.allocate(bytes)),
            #[cfg(feature = "cuda")]
            Self::Nvidia(gpu) => gpu.allocate(bytes),
        }
    }

    /// Bytes allocated.
    #[must_use]
    pub fn allocated(&self) -> usize {
        match self {
            Self::Host(host) => host.allocated(),
            #[cfg(feature = "cuda")]
            Self::Nvidia(gpu) => gpu.allocated(),
        }
    }

    /// Copies numbers to an address that [`Machine::allocate`] gave, after everything that was run before.
    pub fn upload<T: bytemuck::Pod>(&mut self, address: u64, values: &[T]) -> Result<(), GpuError> {
        let bytes = bytemuck::cast_slice(values);
        match self {
            Self::Host(host) => host.upload(address, bytes),
            #[cfg(feature = "cuda")]
            Self::Nvidia(gpu) => gpu.upload(address, bytes)?,
        }
        Ok(())
    }

    /// Copies numbers from an address, after everything that was run before.
    pub fn download<T: bytemuck::Pod>(&mut self, address: u64, values: &mut [T]) -> Result<(), GpuError> {
        let bytes = bytemuck::cast_slice_mut(values);
        match self {
            Self::Host(host) => host.download(address, bytes),
            #[cfg(feature = "cuda")]
            Self::Nvidia(gpu) => gpu.download(address, bytes)?,
        }
        Ok(())
    }

    /// Makes a program ready; on a GPU it is captured, so that its first run costs what every run does.
    pub fn prepare(&mut self, finished: Finished) -> Result<Ready, GpuError> {
        Ok(Ready {
            #[cfg(feature = "cuda")]
            graph: match self {
                Self::Host(_) => None,
                Self::Nvidia(gpu) => gpu.capture(&finished)?,
            },
            finished,
        })
    }

    /// Runs a program; on a GPU it may be under way when this returns.
    pub fn run(&mut self, program: &Ready) -> Result<(), GpuError> {
        match self {
            Self::Host(host) => host.run(&program.finished),
            #[cfg(feature = "cuda")]
            Self::Nvidia(gpu) => gpu.run(program.graph.as_ref())?,
        }
        Ok(())
    }

    /// Runs a program command by command and says how long each part took.
    pub fn time_parts(&mut self, program: &Ready) -> Result<Vec<PartTime>, GpuError> {
        match self {
            Self::Host(host) => Ok(host.time_parts(&program.finished)),
            #[cfg(feature = "cuda")]
            Self::Nvidia(gpu) => gpu.time_parts(&program.finished),
        }
    }
}

impl Machine {
    /// How long each kind of command of a program takes by itself, the dearest first; nothing on the host.
    pub fn time_commands(&mut self, program: &Ready) -> Result<Vec<CommandTime>, GpuError> {
        match self {
            Self::Host(_) => Ok(Vec::new()),
            #[cfg(feature = "cuda")]
            Self::Nvidia(gpu) => gpu.time_commands(&program.finished),
        }
    }
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
    n: [i32; 16],
    f: [f32; 8],
}

impl Args {
    fn new(p: &[Pointer], n: &[i32], f: &[f32]) -> Self {
        let mut args = Self::default();
        for (to, from) in args.p.iter_mut().zip(p) {
            *to = from.place.map_or(0, |place| address(place) + from.bytes as u64);
        }
        args.n[..n.len()].copy_from_slice(n);
        args.f[..f.len()].copy_from_slice(f);
        args
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
