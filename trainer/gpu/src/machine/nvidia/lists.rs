//! Lists of tasks by clusters of blocks, where the GPU has them (compute capability 9.0 and later).

use std::ffi::c_void;

use cudarc::driver::{CudaFunction, CudaStream, sys};

use super::{Nvidia, failed};
use crate::lists::{LISTED, Lists, Task, WARPS, gather, shared_bytes};
use crate::machine::{Args, GpuError, LIST_WIDTHS};
use crate::program::{Command, Finished};

/// Words of what the clusters of a launch tell each other.
const CONTROL_WORDS: usize = 8;
/// Clusters of a launch.
const LISTS_MAX: usize = 2;

/// The words of a task, its arguments first; the same in `kernels/lists.c`.
fn words_of(task: &Task) -> Vec<u32> {
    let Args { p, n, f } = Args::new(&task.p, &task.n, &task.f);
    let kernel = LISTED.iter().position(|kernel| *kernel == task.kernel).unwrap_or(LISTED.len());
    let last = [kernel, task.blocks.start, task.blocks.len(), 0].map(|x| x as u32);
    let p = p.iter().flat_map(|p| [*p as u32, (*p >> 32) as u32]);
    p.chain(n.map(|n| n as u32)).chain(f.map(f32::to_bits)).chain(last).collect()
}

/// Calls `with` with a launch of `clusters` clusters of `width` blocks.
fn configure<T>(
    stream: &CudaStream,
    (clusters, width): (usize, usize),
    shared_bytes: usize,
    with: impl FnOnce(&sys::CUlaunchConfig) -> T,
) -> T {
    let dimension = sys::CUlaunchAttributeValue_union__bindgen_ty_1 { x: width as u32, y: 1, z: 1 };
    let mut attribute = sys::CUlaunchAttribute {
        id: sys::CUlaunchAttributeID::CU_LAUNCH_ATTRIBUTE_CLUSTER_DIMENSION,
        pad: [0; 4],
        value: sys::CUlaunchAttributeValue { clusterDim: dimension },
    };
    with(&sys::CUlaunchConfig {
        gridDimX: (clusters * width) as u32,
        gridDimY: 1,
        gridDimZ: 1,
        blockDimX: 32 * WARPS as u32,
        blockDimY: 1,
        blockDimZ: 1,
        sharedMemBytes: shared_bytes as u32,
        hStream: stream.cu_stream(),
        attrs: &raw mut attribute,
        numAttrs: 1,
    })
}

impl Nvidia {
    /// Makes lists of a program's forked parts where this GPU can run them, and uploads them.
    pub(in crate::machine) fn prepare(&mut self, finished: &mut Finished) -> Result<(), GpuError> {
        let Some(function) = self.lists.clone() else { return Ok(()) };
        let shared_bytes = finished.items.iter().map(shared_bytes).max().unwrap_or_default();
        let Some(width) = self.list_width(&function, shared_bytes)? else { return Ok(()) };
        gather(finished, width);
        for item in &mut finished.items {
            if let Command::Lists(lists) = &mut item.command {
                let tasks: Vec<u32> = lists.tasks().flat_map(words_of).collect();
                let [table, marks] = [lists.table(), lists.marks().concat()]
                    .map(|words| words.into_iter().map(|word| word as u32).collect::<Vec<u32>>());
                let control = vec![0; CONTROL_WORDS];
                for (place, words) in lists.places.iter_mut().zip([tasks, table, marks, control]) {
                    *place = self.allocate(4 * words.len())?;
                    self.upload(*place, bytemuck::cast_slice(&words))?;
                }
            }
        }
        Ok(())
    }

    /// The most blocks of a cluster of which the GPU holds as many at a time as a launch has.
    fn list_width(
        &mut self,
        function: &CudaFunction,
        shared_bytes: usize,
    ) -> Result<Option<usize>, GpuError> {
        use sys::CUfunction_attribute as Attribute;
        let shared = Attribute::CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES;
        let wide = Attribute::CU_FUNC_ATTRIBUTE_NON_PORTABLE_CLUSTER_SIZE_ALLOWED;
        // Programs share the function: it keeps what the largest of them needs.
        self.list_shared_bytes = self.list_shared_bytes.max(shared_bytes);
        let most = self.list_shared_bytes as i32;
        function.set_attribute(shared, most).map_err(failed("asking for shared memory"))?;
        function.set_attribute(wide, 1).map_err(failed("asking for wide clusters"))?;
        let held = |width: &usize| {
            let mut clusters = 0;
            configure(&self.stream, (LISTS_MAX, *width), shared_bytes, |config| {
                // SAFETY: function and configuration are alive.
                unsafe {
                    sys::cuOccupancyMaxActiveClusters(&raw mut clusters, function.cu_function(), config)
                }
            })
            .result()
            .is_ok_and(|()| clusters as usize >= LISTS_MAX)
        };
        Ok(LIST_WIDTHS.into_iter().find(held))
    }

    pub(super) fn launch_lists(&self, lists: &Lists) -> Result<(), GpuError> {
        let Some(function) = &self.lists else { return Ok(()) };
        let phases = |at: usize| lists.lists.get(at).map_or(0, |list| list.len() as i32);
        let mut args = Args::default();
        args.p[..lists.places.len()].copy_from_slice(&lists.places);
        args.n[..3].copy_from_slice(&[phases(0), phases(1), lists.width as i32]);
        let mut parameters = [(&raw mut args).cast::<c_void>()];
        configure(&self.stream, (lists.lists.len(), lists.width), lists.shared_bytes, |config| {
            // SAFETY: the kernel takes one argument of this type, and what it points to was uploaded for it.
            unsafe {
                sys::cuLaunchKernelEx(
                    config,
                    function.cu_function(),
                    parameters.as_mut_ptr(),
                    std::ptr::null_mut(),
                )
            }
        })
        .result()
        .map_err(failed("launching lists"))
    }
}
