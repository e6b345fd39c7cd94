//! An observation as C sees it: places in the message's own memory, to be filled.

use rcwm_models::wire::{ObservationFlags, ObservationHeader, ObservationMut};

use crate::border::growing;

/// Most cameras of a robot.
pub const RCWM_CAMERAS_MAX: usize = 8;
const _: () = assert!(RCWM_CAMERAS_MAX == rcwm_models::wire::CAMERAS_MAX);

/// rcwm_observation.flags: first of its episode.
pub const RCWM_FLAG_FIRST: u32 = 1;
/// Last of its episode: it is answered, and the answer is not executed.
pub const RCWM_FLAG_LAST: u32 = 2;
/// The episode ended because the task did, not because its time was up.
pub const RCWM_FLAG_TERMINAL: u32 = 4;
/// The task counts as solved.
pub const RCWM_FLAG_SUCCESS: u32 = 8;
/// The masks of all cameras that have one are filled in.
pub const RCWM_FLAG_MASK_VALID: u32 = 16;
/// Nobody's answer was executed: the robot held or rested.
pub const RCWM_FLAG_ACTION_HELD: u32 = 32;
const _: () = assert!(
    RCWM_FLAG_FIRST == ObservationFlags::FIRST.0
        && RCWM_FLAG_LAST == ObservationFlags::LAST.0
        && RCWM_FLAG_TERMINAL == ObservationFlags::TERMINAL.0
        && RCWM_FLAG_SUCCESS == ObservationFlags::SUCCESS.0
        && RCWM_FLAG_MASK_VALID == ObservationFlags::MASK_VALID.0
        && RCWM_FLAG_ACTION_HELD == ObservationFlags::ACTION_HELD.0
);

/// One camera's place in an observation. The pointers are the library's: write what they point to, not them.
#[derive(Debug, Clone, Copy)]
#[repr(C)]
pub struct Camera {
    /// Upright, row by row, red, green and blue.
    pub image: *mut u8,
    pub image_bytes: usize,
    /// A byte a pixel, 255 where the robot is, else 0; null where the camera has none.
    pub mask: *mut u8,
    pub mask_bytes: usize,
    /// When the picture was taken: CLOCK_MONOTONIC in nanoseconds. Holds the present time; write over it where you know better.
    pub captured_ns: u64,
}

/// What a robot sees, to be filled in place. Pictures and numbers hold what was there before.
#[derive(Debug, Clone, Copy)]
#[repr(C)]
pub struct Observation {
    /// sizeof(rcwm_observation): of the library's where it hands one to a callback, else of the program's.
    pub size: usize,
    /// Counts observations, from 0.
    pub sequence: u64,
    /// Counts episodes, from 0.
    pub episode: u64,
    /// Counts observations of the episode, from 0.
    pub step: u32,
    /// To be set: RCWM_FLAG_...
    pub flags: u32,
    /// To be set: reward of the last step.
    pub reward: f32,
    /// How many places of `cameras` are used.
    pub camera_count: u32,
    /// To be filled: all measured numbers in the interface's order, see rcwm_robot_find_state().
    pub state: *mut f32,
    pub state_numbers: usize,
    /// What was executed to get here, in the interface's units. Only a loop of your own fills it.
    pub executed: *mut f32,
    pub executed_numbers: usize,
    /// In the interface's order, see rcwm_robot_find_camera().
    pub cameras: [Camera; RCWM_CAMERAS_MAX],
    /// When the observation was due: CLOCK_MONOTONIC in nanoseconds. Only a loop of your own sets it, in real time.
    pub scheduled_ns: u64,
    /// The control period in real time; 0 in lock-step, where every observation waits for its answer. Only a loop of your own sets it.
    pub period_ns: u64,
}

growing!(Observation, "rcwm_observation", period_ns);

impl Observation {
    /// The places of a message; they are good until the message is used otherwise.
    pub(super) fn of(message: &mut ObservationMut<'_>) -> Self {
        let header: ObservationHeader = **message;
        let format = std::sync::Arc::clone(message.view().format());
        let layout = format.layout();
        let base = message.payload().as_mut_ptr();
        // SAFETY: the layout's blocks lie within the message.
        let at = |bytes: &std::ops::Range<usize>| unsafe { base.add(bytes.start) };
        let none = Camera {
            image: std::ptr::null_mut(),
            image_bytes: 0,
            mask: std::ptr::null_mut(),
            mask_bytes: 0,
            captured_ns: 0,
        };
        let mut cameras = [none; RCWM_CAMERAS_MAX];
        for (index, (camera, (image, mask))) in
            cameras.iter_mut().zip(layout.cameras.iter().zip(&layout.masks)).enumerate()
        {
            let mask = mask.as_ref().map(|mask| &mask.bytes);
            *camera = Camera {
                image: at(&image.bytes),
                image_bytes: image.bytes.len(),
                mask: mask.map_or(std::ptr::null_mut(), &at),
                mask_bytes: mask.map_or(0, ExactSizeIterator::len),
                captured_ns: header.captured_ns[index],
            };
        }
        Self {
            size: size_of::<Self>(),
            sequence: header.sequence,
            episode: header.episode,
            step: header.step,
            flags: header.flags,
            reward: header.reward,
            camera_count: layout.cameras.len() as u32,
            state: at(&layout.state.bytes).cast(),
            state_numbers: layout.state.bytes.len() / size_of::<f32>(),
            executed: at(&layout.executed.bytes).cast(),
            executed_numbers: layout.executed.bytes.len() / size_of::<f32>(),
            cameras,
            scheduled_ns: header.scheduled_ns,
            period_ns: header.period_ns,
        }
    }

    /// Takes over what the program has set beside the message's own memory.
    pub(super) fn give_to(&self, header: &mut ObservationHeader) {
        (header.flags, header.reward) = (self.flags, self.reward);
        for (to, camera) in header.captured_ns.iter_mut().zip(&self.cameras) {
            *to = camera.captured_ns;
        }
    }
}
