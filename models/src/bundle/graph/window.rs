//! Windows over pictures.

use super::attributes::Attributes;

/// Two dimensions, as every convolution here: kernel, strides and pads.
pub(super) struct Window {
    pub(super) kernel: [usize; 2],
    pub(super) strides: [usize; 2],
    /// Added (or cut) at both ends together.
    pub(super) pads: [usize; 2],
}

impl Window {
    pub(super) fn read(attributes: &mut Attributes<'_>, kernel: [usize; 2]) -> Result<Self, String> {
        let as_i64 = kernel.map(|side| side as i64);
        attributes.only("kernel_shape", &as_i64)?;
        attributes.only("dilations", &[1, 1])?;
        if let Some(group) = attributes.int("group")?.filter(|group| *group != 1) {
            return Err(format!("group is {group}, expected 1"));
        }
        let strides = small(attributes.ints("strides")?.unwrap_or(&[1, 1]), 1, 64)?;
        let pads: [usize; 4] = small(attributes.ints("pads")?.unwrap_or(&[0; 4]), 0, 64)?;
        let ends = [0, 1].map(|i| (pads[i], pads[i + 2], kernel[i]));
        if ends.iter().any(|(begin, end, side)| begin >= side || end >= side) {
            return Err(format!("pads {pads:?} are not smaller than the kernel {kernel:?}"));
        }
        Ok(Self { kernel, strides, pads: ends.map(|(begin, end, _)| begin + end) })
    }
}

pub(super) fn small<const N: usize>(found: &[i64], min: usize, max: usize) -> Result<[usize; N], String> {
    let sized: Option<Vec<usize>> = found.iter().map(|x| usize::try_from(*x).ok()).collect();
    let fits = sized.filter(|sized| sized.iter().all(|x| (min..=max).contains(x)));
    fits.and_then(|sized| sized.try_into().ok())
        .ok_or_else(|| format!("numbers {found:?}, expected {N} from {min} to {max}"))
}

/// How often a window fits into a side of so many pixels.
pub(super) fn picture_side(window: &Window, i: usize, len: usize) -> Result<usize, String> {
    let covered = len.checked_add(window.pads[i]).and_then(|len| len.checked_sub(window.kernel[i]));
    let covered = covered.ok_or_else(|| format!("kernel {:?} on a side of {len}", window.kernel))?;
    Ok(covered / window.strides[i] + 1)
}
