//! An observation: its header, and the blocks of its payload.

use std::ops::{Deref, DerefMut};
use std::sync::Arc;

use bytemuck::{cast_slice, cast_slice_mut};
use iceoryx2::sample::Sample;

use super::link::Ipc;
use super::{ActionValues, Format, ObservationHeader};

/// As many bytes as every block is aligned to.
#[derive(Debug, Clone, Copy, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C, align(64))]
struct Line([u8; 64]);

/// What a simulator or a robot saw, and what it had done to get there: a complete transition, wherever it lies.
///
/// Images are upright, rows first, channels last (RGB). Numbers are in the interface's units and order.
#[derive(Clone, Copy)]
pub struct Observation<'a> {
    header: &'a ObservationHeader,
    format: &'a Arc<Format>,
    payload: &'a [u8],
}

impl Deref for Observation<'_> {
    type Target = ObservationHeader;
    fn deref(&self) -> &ObservationHeader {
        self.header
    }
}

impl PartialEq for Observation<'_> {
    fn eq(&self, other: &Self) -> bool {
        self.header == other.header && self.format == other.format && self.payload == other.payload
    }
}

impl std::fmt::Debug for Observation<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (state, executed) = (self.state(), self.executed());
        f.debug_struct("Observation")
            .field("header", &self.header)
            .field("state", &state)
            .field("executed", &executed)
            .finish_non_exhaustive()
    }
}

impl<'a> Observation<'a> {
    /// All blocks, as they lie in shared memory.
    #[must_use]
    pub fn payload(&self) -> &'a [u8] {
        self.payload
    }

    #[must_use]
    pub fn format(&self) -> &'a Arc<Format> {
        self.format
    }

    /// All measured numbers, one state after the other.
    #[must_use]
    pub fn state(&self) -> &'a [f32] {
        cast_slice(&self.payload[self.format.layout().state.bytes.clone()])
    }

    /// The action that led here, as executed. At the first of an episode zeros, or, where actions are absolute positions, the one that the
    /// robot holds.
    #[must_use]
    pub fn executed(&self) -> &'a [f32] {
        cast_slice(&self.payload[self.format.layout().executed.bytes.clone()])
    }

    /// The same, copied.
    #[must_use]
    pub fn executed_action(&self) -> ActionValues {
        self.executed().iter().copied().collect()
    }

    /// The picture of a camera, by its place in the interface.
    #[must_use]
    pub fn image(&self, camera: usize) -> &'a [u8] {
        &self.payload[self.format.layout().cameras[camera].bytes.clone()]
    }

    /// A camera's mask, 255 where the robot is, else 0; none where the camera has none or this observation came without.
    #[must_use]
    pub fn mask(&self, camera: usize) -> Option<&'a [u8]> {
        let block = self.format.layout().masks[camera].as_ref()?;
        self.is(super::ObservationFlags::MASK_VALID).then(|| &self.payload[block.bytes.clone()])
    }

    /// Whether the executed action is one that a robot can have executed: every number finite and, but for rounding, within its limits; or
    /// all zeros at the first of an episode, which say that nothing was executed.
    #[must_use]
    pub fn has_executable_action(&self) -> bool {
        let nothing = self.is(super::ObservationFlags::FIRST) && self.executed().iter().all(|x| *x == 0.0);
        nothing || self.format.is_executable(self.executed())
    }

    /// Whether every number in it is finite and the executed action in range; nothing else may reach a policy.
    #[must_use]
    pub fn is_valid(&self) -> bool {
        self.is_finite() && self.has_executable_action()
    }

    /// Whether every number in it is finite.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        let numbers = self.executed().iter().chain(self.state());
        self.reward.is_finite() && numbers.copied().all(f32::is_finite)
    }
}

/// An observation that was received; it stays valid while this is held.
#[derive(Debug)]
pub struct ObservationSample {
    header: ObservationHeader,
    format: Arc<Format>,
    sample: Sample<Ipc, [u8], ObservationHeader>,
}

impl ObservationSample {
    /// Its payload must be as long as the format says; if not, how long it is.
    pub(super) fn new(
        sample: Sample<Ipc, [u8], ObservationHeader>,
        format: &Arc<Format>,
    ) -> Result<Self, usize> {
        let payload = sample.payload();
        let fits = payload.len() == format.layout().observation_bytes;
        if !fits || !payload.as_ptr().cast::<u64>().is_aligned() {
            return Err(payload.len());
        }
        // Read once: a peer may go on writing.
        Ok(Self { header: *sample.user_header(), format: Arc::clone(format), sample })
    }

    #[must_use]
    pub fn view(&self) -> Observation<'_> {
        Observation { header: &self.header, format: &self.format, payload: self.sample.payload() }
    }

    /// Which publisher it is from.
    #[must_use]
    pub fn origin(&self) -> u128 {
        self.sample.origin().value()
    }
}

impl Deref for ObservationSample {
    type Target = ObservationHeader;
    fn deref(&self) -> &ObservationHeader {
        &self.header
    }
}

/// An observation with memory of its own.
#[derive(Debug, PartialEq)]
pub struct OwnedObservation {
    header: ObservationHeader,
    format: Arc<Format>,
    payload: Vec<Line>,
}

impl Deref for OwnedObservation {
    type Target = ObservationHeader;
    fn deref(&self) -> &ObservationHeader {
        &self.header
    }
}

impl DerefMut for OwnedObservation {
    fn deref_mut(&mut self) -> &mut ObservationHeader {
        &mut self.header
    }
}

impl From<Observation<'_>> for OwnedObservation {
    fn from(from: Observation<'_>) -> Self {
        let mut copy = Self::zeroed(from.format);
        copy.copy(&from);
        copy
    }
}

impl Clone for OwnedObservation {
    fn clone(&self) -> Self {
        self.view().into()
    }
}

impl OwnedObservation {
    /// An observation of zeros.
    #[must_use]
    pub fn zeroed(format: &Arc<Format>) -> Self {
        let lines = format.layout().observation_bytes / size_of::<Line>();
        let payload = vec![Line([0; 64]); lines];
        Self { header: ObservationHeader::zeroed(), format: Arc::clone(format), payload }
    }

    #[must_use]
    pub fn view(&self) -> Observation<'_> {
        Observation { header: &self.header, format: &self.format, payload: cast_slice(&self.payload) }
    }

    pub fn edit(&mut self) -> ObservationMut<'_> {
        let payload = cast_slice_mut(&mut self.payload);
        ObservationMut { header: &mut self.header, format: &self.format, payload }
    }

    /// Takes another over; allocates nothing where both are of one format.
    pub fn copy(&mut self, from: &Observation<'_>) {
        self.take_header(from);
        self.edit().payload.copy_from_slice(from.payload);
    }

    /// The same but for its pictures and masks, which stay what they were.
    pub fn copy_numbers(&mut self, from: &Observation<'_>) {
        self.take_header(from);
        let end = self.format.layout().executed.bytes.end;
        self.edit().payload[..end].copy_from_slice(&from.payload[..end]);
    }

    fn take_header(&mut self, from: &Observation<'_>) {
        let same = Arc::ptr_eq(&self.format, from.format) || self.format.hash() == from.format.hash();
        if !same {
            *self = Self::zeroed(from.format);
        }
        self.header = *from.header;
    }
}

/// An observation that is being written; its header's fields are its own.
pub struct ObservationMut<'a> {
    pub(super) header: &'a mut ObservationHeader,
    pub(super) format: &'a Arc<Format>,
    pub(super) payload: &'a mut [u8],
}

impl Deref for ObservationMut<'_> {
    type Target = ObservationHeader;
    fn deref(&self) -> &ObservationHeader {
        self.header
    }
}

impl DerefMut for ObservationMut<'_> {
    fn deref_mut(&mut self) -> &mut ObservationHeader {
        self.header
    }
}

impl ObservationMut<'_> {
    /// See [`Observation::payload`].
    pub fn payload(&mut self) -> &mut [u8] {
        self.payload
    }

    /// See [`Observation::state`].
    pub fn state(&mut self) -> &mut [f32] {
        cast_slice_mut(&mut self.payload[self.format.layout().state.bytes.clone()])
    }

    /// See [`Observation::executed`].
    pub fn executed(&mut self) -> &mut [f32] {
        cast_slice_mut(&mut self.payload[self.format.layout().executed.bytes.clone()])
    }

    /// See [`Observation::image`].
    pub fn image(&mut self, camera: usize) -> &mut [u8] {
        &mut self.payload[self.format.layout().cameras[camera].bytes.clone()]
    }

    /// See [`Observation::mask`]; none where the camera has none. It counts where the flag is set.
    pub fn mask(&mut self, camera: usize) -> Option<&mut [u8]> {
        let block = self.format.layout().masks[camera].as_ref()?;
        Some(&mut self.payload[block.bytes.clone()])
    }

    /// What is written so far.
    #[must_use]
    pub fn view(&self) -> Observation<'_> {
        Observation { header: self.header, format: self.format, payload: self.payload }
    }

    /// All of another of the same format, its header too.
    pub fn copy(&mut self, from: &Observation<'_>) {
        *self.header = *from.header;
        self.payload.copy_from_slice(from.payload);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_non_finite_observation_is_seen() {
        let mut observation = OwnedObservation::zeroed(&Format::metaworld());
        assert!(observation.view().is_finite());
        observation.edit().state()[17] = f32::NAN;
        assert!(!observation.view().is_finite() && !observation.view().is_valid());
    }

    #[test]
    fn an_executed_action_out_of_range_makes_an_observation_invalid() {
        let mut observation = OwnedObservation::zeroed(&Format::metaworld());
        for (executed, valid) in
            [(-1.0, true), (1.0 + f32::EPSILON, true), (1.1, false), (-3e38, false), (f32::NAN, false)]
        {
            observation.edit().executed()[2] = executed;
            assert_eq!(observation.view().is_valid(), valid, "{executed}");
        }
    }

    #[test]
    fn blocks_do_not_meet_and_a_copy_of_numbers_leaves_pictures() {
        let format = Format::metaworld();
        let (mut from, mut to) = (OwnedObservation::zeroed(&format), OwnedObservation::zeroed(&format));
        let mut edited = from.edit();
        edited.sequence = 3;
        edited.state().fill(1.0);
        edited.executed().fill(0.5);
        edited.image(0).fill(7);
        edited.mask(0).unwrap().fill(255);
        assert!(from.view().mask(0).is_none(), "no flag says that there is one");
        from.flags = super::super::ObservationFlags::MASK_VALID.0;
        assert!(from.view().mask(0).unwrap().iter().all(|pixel| *pixel == 255));
        to.copy_numbers(&from.view());
        assert!(
            to.view().state() == from.view().state()
                && to.view().executed() == from.view().executed()
                && to.sequence == 3
        );
        assert!(to.view().image(0).iter().all(|byte| *byte == 0));
        to.copy(&from.view());
        assert_eq!(to, from);
    }
}
