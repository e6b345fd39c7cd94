//! Commands over buffers.

use std::ops::Range;

use crate::kernel::Kernel;

/// A place in memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Buffer {
    /// An address that outlives programs.
    Fixed(u64),
    /// A buffer of a program, given an address when the program is finished.
    Transient(u32),
}

/// A matrix of f32 [rows, cols] whose columns are contiguous and whose rows are `stride` numbers apart.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Matrix {
    pub place: Buffer,
    /// Where it begins in the buffer, in numbers.
    pub offset: usize,
    pub rows: usize,
    /// Columns.
    pub cols: usize,
    /// Distance of rows, in numbers.
    pub stride: usize,
}

impl Matrix {
    /// A contiguous matrix at an address.
    #[must_use]
    pub fn fixed(address: u64, rows: usize, cols: usize) -> Self {
        Self { place: Buffer::Fixed(address), offset: 0, rows, cols, stride: cols }
    }

    /// Some of its rows.
    #[must_use]
    pub fn rows(self, rows: Range<usize>) -> Self {
        assert!(rows.end <= self.rows, "rows {rows:?} of {}", self.rows);
        Self { offset: self.offset + rows.start * self.stride, rows: rows.len(), ..self }
    }

    /// Some of its columns.
    #[must_use]
    pub fn columns(self, columns: Range<usize>) -> Self {
        assert!(columns.end <= self.cols, "columns {columns:?} of {}", self.cols);
        Self { offset: self.offset + columns.start, cols: columns.len(), ..self }
    }

    /// The same numbers in rows of another length.
    #[must_use]
    pub fn reshape(self, rows: usize, cols: usize) -> Self {
        assert!(self.is_contiguous() && rows * cols == self.len(), "{self:?} as {rows} x {cols}");
        Self { rows, cols, stride: cols, ..self }
    }

    /// Numbers in it.
    #[must_use]
    pub fn len(self) -> usize {
        self.rows * self.cols
    }

    /// Whether it holds nothing.
    #[must_use]
    pub fn is_empty(self) -> bool {
        self.len() == 0
    }

    /// Whether its rows follow each other without a gap.
    #[must_use]
    pub fn is_contiguous(self) -> bool {
        self.stride == self.cols || self.rows == 1
    }

    /// The pointer to its first number.
    #[must_use]
    pub fn pointer(self) -> Pointer {
        Pointer { place: Some(self.place), bytes: 4 * self.offset }
    }
}

/// An argument that is an address; null without a place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pointer {
    pub place: Option<Buffer>,
    /// Distance from its begin.
    pub bytes: usize,
}

impl Pointer {
    /// No address.
    pub const NULL: Self = Self { place: None, bytes: 0 };
}

impl From<Matrix> for Pointer {
    fn from(matrix: Matrix) -> Self {
        matrix.pointer()
    }
}

impl From<Option<Matrix>> for Pointer {
    fn from(matrix: Option<Matrix>) -> Self {
        matrix.map_or(Self::NULL, Matrix::pointer)
    }
}

/// How a kernel is spread over blocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Grid {
    pub blocks: usize,
    /// Threads of a block.
    pub threads: usize,
    /// Shared memory of a block.
    pub shared_bytes: usize,
}

/// Rows up to which products are done by kernels of our own.
pub const FEW_ROWS: usize = 32;
/// Blocks beyond which a kernel's threads take turns.
const BLOCKS_MAX: usize = 132 * 16;

impl Grid {
    /// A thread for each of `count` numbers.
    #[must_use]
    pub fn elements(count: usize) -> Self {
        Self { blocks: count.div_ceil(256).clamp(1, BLOCKS_MAX), threads: 256, shared_bytes: 0 }
    }

    /// A warp for each of `count` rows.
    #[must_use]
    pub fn warps(count: usize) -> Self {
        Self { blocks: count.div_ceil(4).clamp(1, BLOCKS_MAX), threads: 128, shared_bytes: 0 }
    }

    /// A warp a row, or a block where rows are few and wide; whether it is a block.
    #[must_use]
    pub fn rows(rows: usize, width: usize) -> (Self, bool) {
        if rows <= 264 && width > 64 {
            (Self { blocks: rows, threads: 256.min(width.next_multiple_of(32)), shared_bytes: 0 }, true)
        } else {
            (Self::warps(rows), false)
        }
    }
}

#[derive(Debug, Clone, PartialEq)]
pub enum Command {
    /// A kernel with its arguments.
    Kernel {
        kernel: Kernel,
        /// Over what.
        grid: Grid,
        /// Addresses.
        p: Vec<Pointer>,
        /// Counts.
        n: Vec<i32>,
        /// Factors.
        f: Vec<f32>,
    },
    /// The other lane goes on only when this one has come here.
    HandOver,
    /// `c = a b + beta c`, row by row: a [m, k] or its transpose, b [k, n] or its transpose.
    Product(Product),
}

/// A matrix product; `transposed` means that the matrix lies the other way round.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Product {
    /// [m, k], or [k, m] transposed.
    pub a: Matrix,
    /// Whether a lies the other way round.
    pub a_transposed: bool,
    /// [k, n], or [n, k] transposed.
    pub b: Matrix,
    /// Whether b lies the other way round.
    pub b_transposed: bool,
    /// [m, n].
    pub c: Matrix,
    /// Whether the product is added to c.
    pub add: bool,
}

impl Product {
    /// The kernel that does this product better than a general one, where there is one: few rows, and addresses that can be read by four.
    pub(crate) fn with_few_rows(&self) -> Option<(Kernel, Grid)> {
        let (m, n, k) = self.sizes();
        let fours = |x: Matrix| x.stride.is_multiple_of(4) && x.offset.is_multiple_of(4);
        if m > FEW_ROWS || self.a_transposed || !k.is_multiple_of(4) || !fours(self.a) {
            return None;
        }
        let groups = m.div_ceil(16);
        if self.b_transposed {
            let grid = Grid {
                blocks: groups * n.div_ceil(4),
                threads: (k / 4).next_multiple_of(32).min(256),
                shared_bytes: 0,
            };
            return fours(self.b).then_some((Kernel::ProductFewRows, grid));
        }
        let warps = (k / 16).clamp(1, 16);
        let grid =
            Grid { blocks: groups * n.div_ceil(32), threads: 32 * warps, shared_bytes: 4 * warps * 16 * 32 };
        Some((Kernel::ProductFewRowsBack, grid))
    }

    /// m, n, k.
    #[must_use]
    pub fn sizes(&self) -> (usize, usize, usize) {
        (self.c.rows, self.c.cols, if self.a_transposed { self.a.rows } else { self.a.cols })
    }
}

/// Which sequence of commands one belongs to: they run side by side between the points where one hands over to another.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub enum Lane {
    /// Where every program begins and ends.
    #[default]
    Main,
    /// Beside it.
    Side,
}

impl Lane {
    #[must_use]
    pub fn other(self) -> Self {
        match self {
            Self::Main => Self::Side,
            Self::Side => Self::Main,
        }
    }
}

/// A command and where it belongs.
#[derive(Debug, Clone, PartialEq)]
pub struct Item {
    /// Which of the program's parts.
    pub part: u16,
    pub lane: Lane,
    /// What is done.
    pub command: Command,
}

/// A program whose buffers have addresses.
#[derive(Debug)]
pub struct Finished {
    /// The commands, with fixed places alone.
    pub items: Vec<Item>,
    /// Names of parts.
    pub parts: Vec<&'static str>,
    /// Memory its buffers take together.
    pub bytes: usize,
}

pub(crate) fn each_place(command: &Command, mut look: impl FnMut(Buffer)) {
    match command {
        Command::Kernel { p, .. } => p.iter().filter_map(|p| p.place).for_each(look),
        Command::HandOver => (),
        Command::Product(p) => [p.a, p.b, p.c].iter().for_each(|m| look(m.place)),
    }
}
