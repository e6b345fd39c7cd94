//! What an update needs, brought to the machine: batches, rates and noise.

use super::programs::{Optimiser, Room, Which, moves};
use super::runs::Runs;
use super::values::{Batch, Colours, Images, Noise};
use crate::machine::GpuError;
use crate::weights::Entry;
use crate::world::Sizes;

impl Runs {
    /// Brings what a run's next update of the world model needs.
    pub(super) fn bring_world(
        &mut self,
        run: usize,
        (which, batch): (Which, &Batch<'_>),
        noise: Noise,
        rate: impl Fn(&str) -> f64,
    ) -> Result<(), GpuError> {
        self.bring_batch(run, batch, noise)?;
        let imitates = self.settings.imitation.is_some();
        if imitates {
            self.bring_examples(run, batch)?;
        }
        let moves = moves(which, imitates);
        self.bring_rates(run, 0, |name| if moves(name) { rate(name) } else { 0.0 })?;
        let number = batch.number as f64 + 1.0;
        // The average begins as the weights after the first update.
        let keep = if number > 1.0 {
            self.settings.average_decay.min((1.0 + number) / (10.0 + number))
        } else {
            0.0
        };
        self.machine.upload(self.room.keep, run, &[keep as f32])
    }

    /// Brings what a run's next update of actor and critic needs.
    pub(super) fn bring_behaviour(&mut self, run: usize, rate: impl Fn(&str) -> f64) -> Result<(), GpuError> {
        if self.programs.behaviour.is_none() {
            return Err(GpuError::Unsupported("this learner was made without actor and critic".to_owned()));
        }
        self.bring_rates(run, 1, &rate)?;
        self.bring_rates(run, 2, &rate)
    }

    fn bring_rates(&mut self, run: usize, which: usize, rate: impl Fn(&str) -> f64) -> Result<(), GpuError> {
        let Some(Optimiser { scales, table, .. }) = self.optimisers.get(which).copied() else {
            return Ok(());
        };
        let row = |(entry, steps): (&Entry, &u64)| {
            let number = (*steps + 1).min(1 << 30) as i32;
            let corrections = [scales.beta1, scales.beta2].map(|beta| 1.0 - beta.powi(number));
            [(rate(&entry.name) / corrections[0]) as f32, (1.0 / corrections[1]) as f32]
        };
        let rows: Vec<f32> = self.weights.entries().iter().zip(&self.steps[run]).flat_map(row).collect();
        self.machine.upload(table, run, &rows)
    }

    pub(super) fn bring_batch(
        &mut self,
        run: usize,
        batch: &Batch<'_>,
        noise: Noise,
    ) -> Result<(), GpuError> {
        let sizes = &self.settings.sizes;
        let (b, t) = (sizes.batch, sizes.length);
        let (rows, action) = (b * t, sizes.model.action);
        let fits = batch.action.len() == rows * action
            && [batch.reward.len(), batch.terminal.len(), batch.first.len()] == [rows; 3]
            && (batch.shift.is_empty() || batch.shift.len() == b)
            && (batch.examples.is_empty() || batch.examples.len() == rows);
        if !fits {
            return Err(GpuError::Unsupported(format!("the batch is not one of {b} sequences of {t} steps")));
        }
        // Row t * B + b is step t of sequence b.
        let from = |row: usize| row % b * t + row / b;
        let begins = |row: usize| row < b || batch.first[from(row)];
        let flags: Vec<u32> = (0..rows).map(|row| u32::from(begins(row))).collect();
        let mut actions = vec![0.0; rows * action];
        for row in (0..rows).filter(|row| !begins(*row)) {
            for (to, x) in
                actions[row * action..][..action].iter_mut().zip(&batch.action[from(row) * action..])
            {
                *to = x / x.abs().max(1.0);
            }
        }
        let reward: Vec<f32> = (0..rows).map(|row| batch.reward[from(row)]).collect();
        let terminal: Vec<f32> =
            (0..rows).map(|row| f32::from(u8::from(batch.terminal[from(row)]))).collect();
        let every = sizes.decode_every as u64;
        let decoded: Vec<u32> = (0..rows as u32)
            .filter(|row| (u64::from(*row) / b as u64 + batch.number).is_multiple_of(every))
            .collect();
        let mut control = [0u32; 10];
        for (word, bytes) in control.iter_mut().zip(noise.key.as_chunks::<4>().0) {
            *word = u32::from_le_bytes(*bytes);
        }
        [control[8], control[9]] = [noise.stream as u32, (noise.stream >> 32) as u32];
        let shift = if batch.shift.is_empty() { vec![[0; 2]; b] } else { batch.shift.to_vec() };

        let Room { inputs, batch_images, batch_masks, .. } = self.room;
        let elsewhere = || {
            let text = "the batch's images are not where they are expected".to_owned();
            Err(GpuError::Unsupported(text))
        };
        let seen = batch.seen;
        let looks = !(seen.host.is_empty() && seen.stored.is_empty() && seen.colours.is_empty());
        if looks && !sizes.looks || !seen.colours.is_empty() && seen.colours.len() != b {
            return elsewhere();
        }
        let colours: Vec<[f32; 8]> = (0..b)
            .map(|row| match seen.colours.get(row).copied().flatten() {
                Some(Colours { gain: [r, g, b], offset: [to_r, to_g, to_b], grey }) => {
                    [r, g, b, to_r, to_g, to_b, grey, 1.0]
                }
                None => [0.0; 8],
            })
            .collect();
        let mut seen_at: Option<Vec<u32>> = None;
        let index: Vec<u32> = match batch.images {
            Images::Stored(places)
                if places.len() == rows
                    && places.iter().all(|place| (*place as usize) < self.settings.stored_images)
                    && (!batch.masks || self.settings.stored_masks) =>
            {
                if !seen.stored.is_empty() {
                    let known = |place: &u32| (*place as usize) < self.settings.stored_images;
                    if seen.stored.len() != rows || !seen.stored.iter().all(known) {
                        return elsewhere();
                    }
                    seen_at = Some((0..rows).map(|row| seen.stored[from(row)]).collect());
                }
                (0..rows).map(|row| places[from(row)]).collect()
            }
            Images::Host(images, masks)
                if images.len() == rows * 12288
                    && self.settings.stored_images == 0
                    && (!batch.masks || masks.len() == rows * 4096) =>
            {
                self.machine.upload(batch_images, run, images)?;
                if batch.masks {
                    self.machine.upload(batch_masks, run, masks)?;
                }
                if !seen.host.is_empty() {
                    if seen.host.len() != images.len() {
                        return elsewhere();
                    }
                    self.machine.upload(batch_images + images.len() as u64, run, seen.host)?;
                    seen_at = Some((0..rows).map(|row| (rows + from(row)) as u32).collect());
                }
                (0..rows).map(|row| from(row) as u32).collect()
            }
            _ => return elsewhere(),
        };
        let machine = &mut self.machine;
        machine.upload(inputs.index, run, &index)?;
        machine.upload(inputs.seen, run, seen_at.as_ref().unwrap_or(&index))?;
        machine.upload(inputs.colours, run, colours.as_flattened())?;
        machine.upload(inputs.shift, run, &shift)?;
        machine.upload(inputs.action, run, &actions)?;
        machine.upload(inputs.reward, run, &reward)?;
        machine.upload(inputs.terminal, run, &terminal)?;
        machine.upload(inputs.first, run, &flags)?;
        machine.upload(inputs.decoded, run, &decoded)?;
        machine.upload(inputs.noise, run, &control)
    }

    /// Brings what was demonstrated: in the states of examples the next step's action, all of the same weight.
    fn bring_examples(&mut self, run: usize, batch: &Batch<'_>) -> Result<(), GpuError> {
        let Sizes { batch: b, length: t, model, .. } = &self.settings.sizes;
        let (rows, action) = (b * t, model.action);
        let count = batch.examples.iter().filter(|example| **example).count().max(1);
        let mut demonstrated = vec![0.0; rows * action];
        let mut counts = vec![0.0; rows];
        for row in 0..rows {
            let from = row % b * t + row / b;
            if row / b + 1 < *t && batch.examples.get(from) == Some(&true) {
                counts[row] = 1.0 / count as f32;
                let next = batch.action[(from + 1) * action..][..action].iter();
                demonstrated[row * action..]
                    .iter_mut()
                    .zip(next)
                    .for_each(|(to, x)| *to = x.clamp(-1.0, 1.0));
            }
        }
        self.machine.upload(self.room.inputs.demonstrated, run, &demonstrated)?;
        self.machine.upload(self.room.inputs.counts, run, &counts)
    }
}
