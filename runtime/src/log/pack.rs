//! Pictures without loss: the difference to the last one, in LZ4. From tick to tick most of a picture stays.

use serde::{Deserialize, Serialize};

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
    pub fn pack(mask: &[u8]) -> Self {
        let byte = |pixels: &[u8]| {
            let bits = pixels.iter().fold(0_u8, |byte, pixel| byte << 1 | u8::from(*pixel > 127));
            bits << (8 - pixels.len())
        };
        let bits: Vec<u8> = mask.chunks(8).map(byte).collect();
        Self { lz4: lz4_flex::block::compress(&bits) }
    }

    /// The mask, of 0 and 255.
    pub fn unpack(&self, mask: &mut [u8]) -> Result<(), String> {
        let mut bits = vec![0; mask.len().div_ceil(8)];
        unpack(&self.lz4, &mut bits)?;
        for (pixels, byte) in mask.chunks_mut(8).zip(bits) {
            for (index, pixel) in pixels.iter_mut().enumerate() {
                *pixel = if byte >> (7 - index) & 1 == 1 { 255 } else { 0 };
            }
        }
        Ok(())
    }
}

/// Packs or unpacks the pictures of one camera, one after another.
#[derive(Default)]
pub struct ImagePacker {
    /// Empty before the first picture.
    last: Vec<u8>,
    difference: Vec<u8>,
}

impl ImagePacker {
    /// `whole` makes a picture that can be unpacked without those before it.
    pub fn pack(&mut self, image: &[u8], whole: bool) -> PackedImage {
        let delta = self.last.len() == image.len() && !whole;
        let lz4 = if delta {
            self.difference.clear();
            self.difference
                .extend(image.iter().zip(&self.last).map(|(pixel, last)| pixel.wrapping_sub(*last)));
            lz4_flex::block::compress(&self.difference)
        } else {
            lz4_flex::block::compress(image)
        };
        self.remember(image);
        PackedImage { delta, lz4 }
    }

    /// The picture; those before it must have been unpacked, unless it is a whole one.
    pub fn unpack(&mut self, packed: &PackedImage, image: &mut [u8]) -> Result<(), String> {
        if packed.delta && self.last.len() != image.len() {
            return Err("a difference to a picture that is not there".into());
        }
        unpack(&packed.lz4, image)?;
        if packed.delta {
            image.iter_mut().zip(&self.last).for_each(|(pixel, last)| *pixel = pixel.wrapping_add(*last));
        }
        self.remember(image);
        Ok(())
    }

    fn remember(&mut self, image: &[u8]) {
        self.last.clear();
        self.last.extend_from_slice(image);
    }
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

    const BYTES: usize = 64 * 64 * 3;

    fn image(shift: usize) -> Vec<u8> {
        (0..BYTES).map(|index| ((index / 300 * 13) + usize::from(index % 900 < shift)) as u8).collect()
    }

    #[test]
    fn pictures_come_back_bit_for_bit_and_small() {
        let (mut packer, mut unpacker) = (ImagePacker::default(), ImagePacker::default());
        for step in 0..40 {
            let packed = packer.pack(&image(step), step % 16 == 0);
            assert_eq!(packed.delta, step % 16 != 0);
            let mut found = [0; BYTES];
            unpacker.unpack(&packed, &mut found).unwrap();
            assert_eq!(found[..], image(step));
            assert!(packed.lz4.len() < BYTES / 4);
        }
    }

    #[test]
    fn a_difference_to_nothing_and_a_short_picture_are_refused() {
        let (mut packer, mut found) = (ImagePacker::default(), [0; BYTES]);
        packer.pack(&image(0), false);
        let delta = packer.pack(&image(1), false);
        assert!(ImagePacker::default().unpack(&delta, &mut found).is_err());
        let short = PackedImage { delta: false, lz4: lz4_flex::block::compress(&[0; 100]) };
        assert!(ImagePacker::default().unpack(&short, &mut found).unwrap_err().contains("100 bytes"));
    }

    #[test]
    fn masks_come_back_as_all_or_nothing() {
        for pixels in [64 * 64, 61] {
            let mask: Vec<u8> = (0..pixels).map(|index| if index % 3 == 0 { 255 } else { 0 }).collect();
            let mut found = vec![7; pixels];
            PackedMask::pack(&mask).unpack(&mut found).unwrap();
            assert_eq!(found, mask);
        }
    }
}
