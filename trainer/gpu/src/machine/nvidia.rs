//! NVIDIA GPUs: kernels compiled by NVRTC when the machine is made, products by cuBLAS, programs as CUDA graphs.

mod products;

use std::collections::HashMap;
use std::ffi::c_void;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, PoisonError};

use cudarc::cublas::{CudaBlas, sys as blas_sys};
use cudarc::driver::{
    CudaContext, CudaEvent, CudaFunction, CudaGraph, CudaSlice, CudaStream, DevicePtr, DeviceRepr,
    LaunchConfig, PushKernelArg, result, sys,
};
use cudarc::nvrtc::{CompileOptions, Ptx, compile_ptx_with_opts};

use super::host::flops;
use super::{Args, CommandTime, GpuError, Kernel, PartTime, Precision, Runs};
use crate::commands::{Command, Finished, Lane};

// SAFETY: plain numbers in C's layout, the same on host and device.
unsafe impl DeviceRepr for Args {}

const SOURCES: [&str; 10] = [
    include_str!("../../kernels/common.h"),
    include_str!("../../kernels/adam.c"),
    include_str!("../../kernels/categorical.c"),
    include_str!("../../kernels/conv.c"),
    include_str!("../../kernels/heads.c"),
    include_str!("../../kernels/interaction.c"),
    include_str!("../../kernels/narrow.c"),
    include_str!("../../kernels/norm.c"),
    include_str!("../../kernels/product.c"),
    include_str!("../../kernels/rows.c"),
];

/// Memory that cuBLAS works in: what NVIDIA recommends for Hopper.
const WORKSPACE_BYTES: usize = 32 << 20;

/// A GPU with a stream of its own.
pub struct Nvidia {
    stream: Arc<CudaStream>,
    /// cuBLAS on the stream, and a stream beside it with its own.
    blas: CudaBlas,
    side: (Arc<CudaStream>, CudaBlas),
    kernels: HashMap<Kernel, CudaFunction>,
    memory: Vec<CudaSlice<u8>>,
    precision: Precision,
}

impl std::fmt::Debug for Nvidia {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Nvidia").field("precision", &self.precision).finish_non_exhaustive()
    }
}

/// A captured program.
pub struct Graph(CudaGraph);

impl std::fmt::Debug for Graph {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Graph")
    }
}

// SAFETY: the runs that share a graph launch it one at a time, behind a lock.
unsafe impl Send for Graph {}

/// The kernels as one source: the header once, and no includes.
pub fn source() -> String {
    SOURCES
        .concat()
        .lines()
        .filter(|line| !line.starts_with("#include \"common.h\""))
        .collect::<Vec<_>>()
        .join("\n")
}

fn failed<E: std::fmt::Debug>(what: &'static str) -> impl FnOnce(E) -> GpuError {
    move |reason| GpuError::Failed { what, reason: format!("{reason:?}") }
}

/// The kernels for an architecture, compiled once a process: it takes seconds.
fn compiled(architecture: &str) -> Result<Ptx, GpuError> {
    static KNOWN: Mutex<Vec<(String, Ptx)>> = Mutex::new(Vec::new());
    let mut known = KNOWN.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some((_, ptx)) = known.iter().find(|(name, _)| name == architecture) {
        return Ok(ptx.clone());
    }
    let options = vec![format!("--gpu-architecture={architecture}")];
    let options = CompileOptions { options, ..CompileOptions::default() };
    let ptx = compile_ptx_with_opts(source(), options)
        .map_err(|error| GpuError::Failed { what: "compiling the kernels", reason: format!("{error:?}") })?;
    known.push((architecture.to_owned(), ptx.clone()));
    Ok(ptx)
}

impl Nvidia {
    pub(super) fn new(ordinal: usize, precision: Precision) -> Result<Self, GpuError> {
        // Libraries that are not there make cudarc panic; that is no reason to print a backtrace.
        static ONE: Mutex<()> = Mutex::new(());
        let _one = ONE.lock().unwrap_or_else(PoisonError::into_inner);
        let hook = std::panic::take_hook();
        std::panic::set_hook(Box::new(|_| {}));
        let made = catch_unwind(AssertUnwindSafe(|| Self::make(ordinal, precision)));
        std::panic::set_hook(hook);
        made.unwrap_or_else(|panic| {
            let text =
                panic.downcast_ref::<String>().cloned().unwrap_or_else(|| "a library is missing".to_owned());
            // What follows is a list of all names that were tried.
            let text = text.split(" - searched").next().unwrap_or_default();
            Err(GpuError::Unavailable(text.lines().next().unwrap_or_default().to_owned()))
        })
    }

    fn make(ordinal: usize, precision: Precision) -> Result<Self, GpuError> {
        let context = CudaContext::new(ordinal).map_err(|error| GpuError::Unavailable(format!("{error}")))?;
        // SAFETY: memory is only used by the two streams, which meet where programs hand over and at their end; no event has to guard it.
        unsafe { context.disable_event_tracking() };
        let stream = context.new_stream().map_err(failed("making a stream"))?;
        let (major, minor) = context.compute_capability().map_err(failed("asking for the architecture"))?;
        let ptx = compiled(&format!("compute_{major}{minor}"))?;
        let module = context.load_module(ptx).map_err(failed("loading the kernels"))?;
        let mut kernels = HashMap::new();
        for kernel in Kernel::ALL {
            let function = module.load_function(kernel.name()).map_err(failed("finding a kernel"))?;
            kernels.insert(*kernel, function);
        }
        for kernel in [Kernel::InteractionForward, Kernel::InteractionBackward] {
            let most = context
                .attribute(sys::CUdevice_attribute::CU_DEVICE_ATTRIBUTE_MAX_SHARED_MEMORY_PER_BLOCK_OPTIN)
                .map_err(failed("asking for shared memory"))?;
            let attribute = sys::CUfunction_attribute::CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES;
            if let Some(function) = kernels.get(&kernel) {
                function.set_attribute(attribute, most).map_err(failed("asking for shared memory"))?;
            }
        }
        let start =
            |stream: &Arc<CudaStream>| CudaBlas::new(stream.clone()).map_err(failed("starting cuBLAS"));
        let beside = context.new_stream().map_err(failed("making a stream"))?;
        let (blas, side) = (start(&stream)?, (beside.clone(), start(&beside)?));
        let mut machine = Self { stream, blas, side, kernels, memory: Vec::new(), precision };
        for lane in [Lane::Main, Lane::Side] {
            machine.set_up_products(lane)?;
        }
        Ok(machine)
    }

    /// Memory and precision of cuBLAS.
    fn set_up_products(&mut self, lane: Lane) -> Result<(), GpuError> {
        let workspace = self.allocate(WORKSPACE_BYTES)?;
        let handle = *self.lane(lane).1.handle();
        // SAFETY: the workspace lives as long as the handle.
        unsafe { blas_sys::cublasSetWorkspace_v2(handle, workspace as *mut c_void, WORKSPACE_BYTES) }
            .result()
            .map_err(failed("giving cuBLAS memory"))?;
        let mode = match self.precision {
            Precision::F32 => blas_sys::cublasMath_t::CUBLAS_DEFAULT_MATH,
            Precision::Tf32 => blas_sys::cublasMath_t::CUBLAS_TF32_TENSOR_OP_MATH,
        };
        // SAFETY: the handle is alive.
        unsafe { blas_sys::cublasSetMathMode(handle, mode) }
            .result()
            .map_err(failed("choosing cuBLAS's precision"))
    }

    fn lane(&self, lane: Lane) -> (&Arc<CudaStream>, &CudaBlas) {
        match lane {
            Lane::Main => (&self.stream, &self.blas),
            Lane::Side => (&self.side.0, &self.side.1),
        }
    }

    pub(super) fn name(&self) -> String {
        self.stream.context().name().unwrap_or_else(|_| "an NVIDIA GPU".to_owned())
    }

    pub(super) fn allocate(&mut self, bytes: usize) -> Result<u64, GpuError> {
        let slice = self
            .stream
            .alloc_zeros::<u8>(bytes)
            .map_err(|error| GpuError::Memory { bytes, reason: format!("{error}") })?;
        let (address, _) = slice.device_ptr(&self.stream);
        self.memory.push(slice);
        Ok(address)
    }

    pub(super) fn allocated(&self) -> usize {
        self.memory.iter().map(CudaSlice::len).sum()
    }

    pub(super) fn upload(&mut self, address: u64, bytes: &[u8]) -> Result<(), GpuError> {
        // SAFETY: the range lies in this machine's memory. Pageable memory is read before the call returns.
        unsafe { result::memcpy_htod_async(address, bytes, self.stream.cu_stream()) }
            .map_err(failed("an upload"))?;
        Ok(())
    }

    pub(super) fn download(&mut self, address: u64, bytes: &mut [u8]) -> Result<(), GpuError> {
        // SAFETY: the range lies in this machine's memory, and the copy has ended when the stream has.
        unsafe { result::memcpy_dtoh_async(bytes, address, self.stream.cu_stream()) }
            .map_err(failed("a download"))?;
        self.stream.synchronize().map_err(failed("running a program"))
    }

    pub(super) fn run(&mut self, graph: Option<&Graph>) -> Result<(), GpuError> {
        match graph {
            Some(graph) => graph.0.launch().map_err(failed("launching a program")),
            None => Ok(()),
        }
    }

    /// A program as a graph.
    pub(super) fn capture(&mut self, program: &Finished, runs: Runs<'_>) -> Result<Option<Graph>, GpuError> {
        // Libraries load their kernels when they are first used, which no other capture may meet: one at a time.
        static ONE: Mutex<()> = Mutex::new(());
        let _one = ONE.lock().unwrap_or_else(PoisonError::into_inner);
        self.stream.synchronize().map_err(failed("waiting"))?;
        let mode = sys::CUstreamCaptureMode::CU_STREAM_CAPTURE_MODE_RELAXED;
        self.stream.begin_capture(mode).map_err(failed("beginning a capture"))?;
        let captured = program.items.iter().try_for_each(|item| self.execute(&item.command, item.lane, runs));
        let made = self.stream.end_capture(sys::CUgraphInstantiate_flags(0));
        captured?;
        Ok(made.map_err(failed("capturing a program"))?.map(Graph))
    }

    pub(super) fn time_parts(
        &mut self,
        program: &Finished,
        runs: Runs<'_>,
    ) -> Result<Vec<PartTime>, GpuError> {
        let mut times: Vec<PartTime> =
            program.parts.iter().map(|part| PartTime { part, commands: 0, ms: 0.0, flops: 0.0 }).collect();
        let event = |machine: &Self| {
            let flags = Some(sys::CUevent_flags::CU_EVENT_DEFAULT);
            machine.stream.record_event(flags).map_err(failed("recording an event"))
        };
        let mut spans: Vec<(u16, CudaEvent)> = Vec::new();
        for item in program.items.iter().filter(|item| item.command != Command::HandOver) {
            if spans.last().is_none_or(|(last, _)| *last != item.part) {
                spans.push((item.part, event(self)?));
            }
            self.execute(&item.command, Lane::Main, runs)?;
            times[usize::from(item.part)].commands += 1;
            times[usize::from(item.part)].flops += runs.count as f64 * flops(&item.command);
        }
        let end = event(self)?;
        self.stream.synchronize().map_err(failed("running a program"))?;
        let ends: Vec<&CudaEvent> = spans.iter().skip(1).map(|(_, event)| event).chain([&end]).collect();
        for ((part, begin), end) in spans.iter().zip(ends) {
            let ms = begin.elapsed_ms(end).map_err(failed("timing"))?;
            times[usize::from(*part)].ms += f64::from(ms);
        }
        Ok(times)
    }

    /// Each distinct command of a program by itself: how often it is there, and how long it takes when it is repeated.
    pub(super) fn time_commands(
        &mut self,
        program: &Finished,
        runs: Runs<'_>,
    ) -> Result<Vec<CommandTime>, GpuError> {
        const REPEATS: u32 = 20;
        let mut kinds: Vec<(String, &Command, usize, &'static str)> = Vec::new();
        let mut places: HashMap<String, usize> = HashMap::new();
        for item in program.items.iter().filter(|item| item.command != Command::HandOver) {
            let command = &item.command;
            let name = describe(command);
            let part = program.parts[usize::from(item.part)];
            let key = format!("{part} {name}");
            match places.get(&key) {
                Some(at) => kinds[*at].2 += 1,
                None => {
                    places.insert(key, kinds.len());
                    kinds.push((name, command, 1, part));
                }
            }
        }
        let mut times = Vec::with_capacity(kinds.len());
        for (name, command, count, part) in kinds {
            self.execute(command, Lane::Main, runs)?;
            let flags = Some(sys::CUevent_flags::CU_EVENT_DEFAULT);
            let begin = self.stream.record_event(flags).map_err(failed("recording an event"))?;
            for _ in 0..REPEATS {
                self.execute(command, Lane::Main, runs)?;
            }
            let end = self.stream.record_event(flags).map_err(failed("recording an event"))?;
            end.synchronize().map_err(failed("running a command"))?;
            let us = 1e3 * f64::from(begin.elapsed_ms(&end).map_err(failed("timing"))?) / f64::from(REPEATS);
            times.push(CommandTime { part, name, count, us });
        }
        times.sort_by(|a, b| (b.us * b.count as f64).total_cmp(&(a.us * a.count as f64)));
        Ok(times)
    }

    fn execute(&self, command: &Command, lane: Lane, runs: Runs<'_>) -> Result<(), GpuError> {
        let (stream, _) = self.lane(lane);
        match command {
            Command::Kernel { kernel, grid, p, n, f } => {
                let args = Args::new(p, n, f, runs);
                let config = LaunchConfig {
                    grid_dim: (grid.blocks as u32, runs.count as u32, 1),
                    block_dim: (grid.threads as u32, 1, 1),
                    shared_mem_bytes: grid.shared_bytes as u32,
                };
                let mut launch = stream.launch_builder(&self.kernels[kernel]);
                launch.arg(&args);
                // SAFETY: the arguments are those that the kernel's description names, and its buffers are as large as its counts say.
                unsafe { launch.launch(config) }
                    .map_err(|error| GpuError::Failed { what: kernel.name(), reason: format!("{error}") })?;
                Ok(())
            }
            Command::HandOver => {
                let event = stream.record_event(None).map_err(failed("handing over"))?;
                self.lane(lane.other()).0.wait(&event).map_err(failed("handing over"))
            }
            Command::Product(product) => self.multiply(product, lane, runs),
        }
    }
}

/// A command by what its time depends on.
fn describe(command: &Command) -> String {
    match command {
        Command::HandOver => String::new(),
        Command::Kernel { kernel, grid, n, .. } => {
            let sizes: Vec<String> = n.iter().take(3).map(i32::to_string).collect();
            format!("{} {}x{} {}", kernel.name(), grid.blocks, grid.threads, sizes.join(","))
        }
        Command::Product(product) => {
            let (m, n, k) = product.sizes();
            let letter = |transposed: bool| if transposed { 't' } else { 'n' };
            let (a, b) = (letter(product.a_transposed), letter(product.b_transposed));
            format!("product {m}x{n}x{k} {a}{b}")
        }
    }
}
