//! Pictures without loss: the difference to the last one, in LZ4. From tick to tick most of a picture stays.

use rcwm_models::{IMAGE_BYTES, MASK_BYTES};
use serde::{Deserialize, Serialize};

/// Bytes of a mask of one bit a pixel.
const MASK_BITS_BYTES: usize = MASK_BYTES / 8;

/// A packed picture.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PackedImage {
    /// It is the difference to the last picture in the log.
    delta: bool,
    lz4: Vec<u8>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PackedMask {
    lz4: Vec<u8>,
}

impl PackedMask {
    /// A pixel of more than one half is the robot.
    pub fn pack(mask: &[u8; MASK_BYTES]) -> Self {
        let mut bits = [0; MASK_BITS_BYTES];
        for (byte, pixels) in bits.iter_mut().zip(mask.chunks_exact(8)) {
            *byte = pixels.iter().fold(0, |byte, pixel| byte << 1 | u8::from(*pixel > 127));
        }
        Self { lz4: lz4_flex::block::compress(&bits) }
    }

    /// The mask, of 0 and 255.
    pub fn unpack(&self, mask: &mut [u8; MASK_BYTES]) -> Result<(), String> {
        let mut bits = [0; MASK_BITS_BYTES];
        unpack(&self.lz4, &mut bits)?;
        for (pixels, byte) in mask.chunks_exact_mut(8).zip(bits) {
            for (index, pixel) in pixels.iter_mut().enumerate() {
                *pixel = if byte >> (7 - index) & 1 == 1 { 255 } else { 0 };
            }
        }
        Ok(())
    }
}

/// Packs or unpacks one picture after another.
pub struct ImagePacker {
    last: Box<[u8; IMAGE_BYTES]>,
    difference: Box<[u8; IMAGE_BYTES]>,
    has_last: bool,
}

impl Default for ImagePacker {
    /// Before the first picture.
    fn default() -> Self {
        let zeros = || Box::new([0; IMAGE_BYTES]);
        Self { last: zeros(), difference: zeros(), has_last: false }
    }
}

impl ImagePacker {
    /// `whole` makes a picture that can be unpacked without those before it.
    pub fn pack(&mut self, image: &[u8; IMAGE_BYTES], whole: bool) -> PackedImage {
        let delta = self.has_last && !whole;
        let lz4 = if delta {
            self.difference.copy_from_slice(image);
            subtract(&mut self.difference, &self.last);
            lz4_flex::block::compress(&self.difference[..])
        } else {
            lz4_flex::block::compress(image)
        };
        self.last.copy_from_slice(image);
        self.has_last = true;
        PackedImage { delta, lz4 }
    }

    /// The picture; those before it must have been unpacked, unless it is a whole one.
    pub fn unpack(&mut self, packed: &PackedImage, image: &mut [u8; IMAGE_BYTES]) -> Result<(), String> {
        if packed.delta && !self.has_last {
            return Err("a difference to a picture that is not there".into());
        }
        unpack(&packed.lz4, image)?;
        if packed.delta {
            add(image, &self.last);
        }
        self.last.copy_from_slice(image);
        self.has_last = true;
        Ok(())
    }
}

fn subtract(image: &mut [u8; IMAGE_BYTES], last: &[u8; IMAGE_BYTES]) {
    image.iter_mut().zip(last).for_each(|(pixel, last)| *pixel = pixel.wrapping_sub(*last));
}

fn add(image: &mut [u8; IMAGE_BYTES], last: &[u8; IMAGE_BYTES]) {
    image.iter_mut().zip(last).for_each(|(pixel, last)| *pixel = pixel.wrapping_add(*last));
}

fn unpack(lz4: &[u8], to: &mut [u8]) -> Result<(), String> {
    let expected = to.len();
    match lz4_flex::block::decompress_into(lz4, to) {
        Ok(found) if found == expected => Ok(()),
        Ok(found) => Err(format!("a picture unpacks to {found} bytes, expected {expected}")),
        Err(error) => Err(format!("a picture does not unpack: {error}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(shift: usize) -> [u8; IMAGE_BYTES] {
        std::array::from_fn(|index| ((index / 300 * 13) + usize::from(index % 900 < shift)) as u8)
    }

    #[test]
    fn pictures_come_back_bit_for_bit_and_small() {
        let (mut packer, mut unpacker) = (ImagePacker::default(), ImagePacker::default());
        for step in 0..40 {
            let packed = packer.pack(&image(step), step % 16 == 0);
            assert_eq!(packed.delta, step % 16 != 0);
            let mut found = [0; IMAGE_BYTES];
            unpacker.unpack(&packed, &mut found).unwrap();
            assert_eq!(found, image(step));
            assert!(packed.lz4.len() < IMAGE_BYTES / 4);
        }
    }

    #[test]
    fn a_difference_to_nothing_and_a_short_picture_are_refused() {
        let (mut packer, mut found) = (ImagePacker::default(), [0; IMAGE_BYTES]);
        packer.pack(&image(0), false);
        let delta = packer.pack(&image(1), false);
        assert!(ImagePacker::default().unpack(&delta, &mut found).is_err());
        let short = PackedImage { delta: false, lz4: lz4_flex::block::compress(&[0; 100]) };
        assert!(ImagePacker::default().unpack(&short, &mut found).unwrap_err().contains("100 bytes"));
    }

    #[test]
    fn masks_come_back_as_all_or_nothing() {
        let mask = std::array::from_fn(|index| if index % 3 == 0 { 255 } else { 0 });
        let mut found = [7; MASK_BYTES];
        PackedMask::pack(&mask).unpack(&mut found).unwrap();
        assert_eq!(found, mask);
    }
}
