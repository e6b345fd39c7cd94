//! Programs: lists of commands, and how their buffers that are not needed at the same time share memory.

use std::ops::Range;

use crate::commands::each_place;
pub use crate::commands::{Buffer, Command, FEW_ROWS, Finished, Grid, Item, Lane, Matrix, Pointer, Product};
use crate::kernel::Kernel;
use crate::machine::{GpuError, Machine};

/// A list of commands under way.
#[derive(Debug, Default)]
pub struct Program {
    items: Vec<Item>,
    parts: Vec<&'static str>,
    sizes: Vec<usize>,
    part: u16,
    lane: Lane,
    /// Where both lanes are in use: what is needed anywhere in such a range is kept for all of it.
    forked: Vec<Range<usize>>,
}

/// Memory that programs use one after the other.
#[derive(Debug, Default)]
pub struct Arena {
    address: u64,
    bytes: usize,
}

const ALIGNMENT: usize = 256;

impl Program {
    /// A buffer of this many numbers; its contents are undefined until something is written.
    pub fn buffer(&mut self, numbers: usize) -> Buffer {
        assert!(numbers < 1 << 31, "kernels count a buffer's numbers in 32 bits");
        self.sizes.push((4 * numbers).next_multiple_of(ALIGNMENT));
        Buffer::Transient(self.sizes.len() as u32 - 1)
    }

    /// Commands from now on belong to this part.
    pub fn part(&mut self, name: &'static str) {
        let known = self.parts.iter().position(|part| *part == name);
        self.part = known.unwrap_or(self.parts.len()) as u16;
        if known.is_none() {
            self.parts.push(name);
        }
    }

    /// The name of the part that commands belong to now.
    #[must_use]
    pub fn current_part(&self) -> &'static str {
        self.parts.get(usize::from(self.part)).copied().unwrap_or_default()
    }

    /// Commands from now on belong to this lane; the one before.
    pub fn lane(&mut self, lane: Lane) -> Lane {
        std::mem::replace(&mut self.lane, lane)
    }

    /// The lane that commands belong to now.
    #[must_use]
    pub fn current_lane(&self) -> Lane {
        self.lane
    }

    /// `from` has come to where the other lane may go on.
    pub fn hand_over(&mut self, from: Lane) {
        let before = self.lane(from);
        self.push(Command::HandOver);
        self.lane(before);
    }

    /// All lanes are in use from here on.
    pub fn fork(&mut self) {
        self.forked.push(self.items.len()..usize::MAX);
    }

    /// The main lane alone is in use from here on.
    pub fn join(&mut self) {
        if let Some(forked) = self.forked.last_mut() {
            forked.end = self.items.len();
        }
    }

    /// Adds a kernel.
    pub fn kernel(&mut self, kernel: Kernel, grid: Grid, p: &[Pointer], n: &[usize], f: &[f32]) {
        let count = |n: &usize| i32::try_from(*n).expect("no matrix has 2^31 numbers");
        let n = n.iter().map(count).collect();
        self.push(Command::Kernel { kernel, grid, p: p.to_vec(), n, f: f.to_vec() });
    }

    /// Adds a matrix product.
    pub fn product(&mut self, product: Product) {
        let (m, n, k) = product.sizes();
        let a = if product.a_transposed {
            (product.a.cols, product.a.rows)
        } else {
            (product.a.rows, product.a.cols)
        };
        let b = if product.b_transposed {
            (product.b.cols, product.b.rows)
        } else {
            (product.b.rows, product.b.cols)
        };
        assert!(a == (m, k) && b == (k, n), "{a:?} x {b:?} is not {m} x {n}");
        match product.with_few_rows() {
            Some((kernel, grid)) => {
                let Product { a, b, c, add, .. } = product;
                let n = [m, n, k, a.stride, b.stride, c.stride, usize::from(add)];
                self.kernel(kernel, grid, &[a.into(), b.into(), c.into()], &n, &[]);
            }
            None => self.push(Command::Product(product)),
        }
    }

    fn push(&mut self, command: Command) {
        if self.parts.is_empty() {
            self.parts.push("other");
        }
        self.items.push(Item { part: self.part, lane: self.lane, command });
    }

    /// Where every buffer lies in an arena, and the arena's bytes: buffers whose first and last uses do not overlap share memory.
    pub fn layout(&self) -> (Vec<usize>, usize) {
        let mut lives: Vec<Option<(usize, usize)>> = vec![None; self.sizes.len()];
        for (at, item) in self.items.iter().enumerate() {
            each_place(&item.command, |place| {
                if let Buffer::Transient(id) = place {
                    let life = lives[id as usize].get_or_insert((at, at));
                    life.1 = at;
                }
            });
        }
        // Lanes run side by side: their order in the list says nothing.
        for life in lives.iter_mut().flatten() {
            for forked in &self.forked {
                if life.0 < forked.end && forked.start <= life.1 {
                    *life = (life.0.min(forked.start), life.1.max(forked.end.min(self.items.len())));
                }
            }
        }
        let mut order: Vec<usize> = (0..self.sizes.len()).filter(|id| lives[*id].is_some()).collect();
        // Large buffers first: small ones fill the gaps between them.
        order.sort_by_key(|id| std::cmp::Reverse(self.sizes[*id]));
        let (mut offsets, mut placed): (Vec<usize>, Vec<usize>) = (vec![0; self.sizes.len()], Vec::new());
        let mut total = 0;
        for id in order {
            let Some((from, to)) = lives[id] else { continue };
            let mut taken: Vec<(usize, usize)> = placed
                .iter()
                .filter(|other| lives[**other].is_some_and(|(first, last)| first <= to && from <= last))
                .map(|other| (offsets[*other], offsets[*other] + self.sizes[*other]))
                .collect();
            taken.sort_unstable();
            let mut offset = 0;
            for (begin, end) in taken {
                if begin >= offset + self.sizes[id] {
                    break;
                }
                offset = offset.max(end);
            }
            offsets[id] = offset;
            total = total.max(offset + self.sizes[id]);
            placed.push(id);
        }
        (offsets, total)
    }

    /// The program with addresses in `arena`, which is large enough for its [`Program::layout`].
    #[must_use]
    pub fn finish(self, offsets: &[usize], bytes: usize, arena: &Arena) -> Finished {
        assert!(bytes <= arena.bytes, "the arena was made for smaller programs");
        let fix = |place: Buffer| match place {
            Buffer::Fixed(address) => Buffer::Fixed(address),
            Buffer::Transient(id) => Buffer::Fixed(arena.address + offsets[id as usize] as u64),
        };
        let matrix = |m: Matrix| Matrix { place: fix(m.place), ..m };
        let items = self.items.into_iter().map(|item| {
            let command = match item.command {
                Command::HandOver => Command::HandOver,
                Command::Kernel { kernel, grid, p, n, f } => {
                    let p = p.into_iter().map(|p| Pointer { place: p.place.map(fix), ..p }).collect();
                    Command::Kernel { kernel, grid, p, n, f }
                }
                Command::Product(p) => {
                    Command::Product(Product { a: matrix(p.a), b: matrix(p.b), c: matrix(p.c), ..p })
                }
            };
            Item { command, ..item }
        });
        Finished { items: items.collect(), parts: self.parts, bytes }
    }
}

impl Arena {
    /// Memory for programs of at most this many bytes.
    ///
    /// # Errors
    /// [`GpuError`] if there is not as much.
    pub fn new(machine: &mut Machine, bytes: usize) -> Result<Self, GpuError> {
        Ok(Self { address: machine.allocate(bytes.max(ALIGNMENT))?, bytes })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buffers_share_memory_only_where_their_lives_do_not_meet() {
        let mut program = Program::default();
        let [a, b, c] = [program.buffer(1000), program.buffer(1000), program.buffer(1000)];
        let m = |place| Matrix { place, offset: 0, rows: 10, cols: 100, stride: 100 };
        let copy = |program: &mut Program, x: Buffer, y: Buffer| {
            program.kernel(Kernel::CopyRows, Grid::elements(1000), &[m(x).into(), m(y).into()], &[], &[]);
        };
        copy(&mut program, a, b);
        copy(&mut program, b, c);
        let (offsets, bytes) = program.layout();
        assert_eq!(offsets[0], offsets[2], "a is dead when c is born");
        assert_ne!(offsets[0], offsets[1]);
        assert_eq!(bytes, 2 * 4096);
    }

    #[test]
    fn buffers_of_a_fork_are_kept_until_its_end() {
        let mut program = Program::default();
        let [a, b, c] = [program.buffer(1000), program.buffer(1000), program.buffer(1000)];
        let m = |place| Matrix { place, offset: 0, rows: 10, cols: 100, stride: 100 };
        program.fork();
        for (x, y) in [(a, b), (b, c)] {
            program.kernel(Kernel::CopyRows, Grid::elements(1000), &[m(x).into(), m(y).into()], &[], &[]);
        }
        program.join();
        let (offsets, bytes) = program.layout();
        assert_ne!(offsets[0], offsets[2], "the other lane may still read a when c is written");
        assert_eq!(bytes, 3 * 4096);
    }
}
