//! Files of `torch.save`: the tensors of `agent_state_dict`, read by candle's pickle reader, which executes nothing.

use std::collections::BTreeMap;
use std::io::Read;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use candle_core::pickle::{PthTensors, TensorInfo};
use candle_core::{DType, Tensor};
use rcwm_models::files::open_capped;

use super::{ImportError, pickle_check};

/// Largest file that is read: the paper's has about 300 MB with its optimisers.
const BYTES_MAX: u64 = 8 << 30;
/// The part of the file with the model's parameters.
const MODEL: &str = "agent_state_dict";

/// A file whose tensors are known by name; none is in memory.
pub(super) struct File {
    path: PathBuf,
    bytes: u64,
    tensors: PthTensors,
    /// The names in the file, by those without what a compiled model puts between.
    names: BTreeMap<String, String>,
}

impl File {
    pub(super) fn open(path: &Path) -> Result<Self, ImportError> {
        let (_, bytes) = open_capped(path, BYTES_MAX)?;
        let refuse = |reason: String| ImportError::Unreadable { path: path.to_path_buf(), reason };
        if let Some(reason) = pickle_of(path).and_then(|bytes| pickle_check::refused(&bytes)) {
            return Err(refuse(reason));
        }
        // The reader was made for files that are whole.
        let read = without_panic(|| PthTensors::new(path, Some(MODEL)));
        let tensors = read.map_err(refuse)?;
        let mut names = BTreeMap::new();
        for name in tensors.tensor_infos().keys() {
            if let Some(other) = names.insert(name.replace("_orig_mod.", ""), name.clone()) {
                return Err(ImportError::Twice { path: path.to_path_buf(), name: name.clone(), other });
            }
        }
        if names.is_empty() {
            return Err(refuse(format!("it holds no tensors under {MODEL}")));
        }
        Ok(Self { path: path.to_path_buf(), bytes, tensors, names })
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    pub(super) fn names(&self) -> impl Iterator<Item = &String> {
        self.names.keys()
    }

    pub(super) fn has(&self, name: &str) -> bool {
        self.names.contains_key(name)
    }

    /// Whether two names mean the same numbers of the file.
    pub(super) fn are_one(&self, name: &str, other: &str) -> bool {
        match (self.info(name), self.info(other)) {
            (Ok(a), Ok(b)) => {
                (&a.path, a.dtype, a.layout.dims()) == (&b.path, b.dtype, b.layout.dims())
                    && a.layout.start_offset() == b.layout.start_offset()
            }
            _ => false,
        }
    }

    fn info(&self, name: &str) -> Result<&TensorInfo, ImportError> {
        let info = self.names.get(name).and_then(|there| self.tensors.tensor_infos().get(there));
        info.ok_or_else(|| ImportError::Unreadable {
            path: self.path.clone(),
            reason: format!("it has no tensor {name}; is it of another --format?"),
        })
    }

    /// The sides of a tensor of so many.
    pub(super) fn sides<const RANK: usize>(&self, name: &str) -> Result<[usize; RANK], ImportError> {
        let dims = self.info(name)?.layout.shape().dims();
        dims.try_into().map_err(|_| self.wrong(name, format!("{dims:?}"), format!("{RANK} dimensions")))
    }

    fn wrong(&self, name: &str, found: String, expected: String) -> ImportError {
        ImportError::Shape { path: self.path.clone(), name: name.to_owned(), found, expected }
    }

    /// A tensor of this shape, f32.
    pub(super) fn get(&self, name: &str, shape: &[usize]) -> Result<Tensor, ImportError> {
        let info = self.info(name)?;
        let found = info.layout.shape().dims();
        if found != shape {
            return Err(self.wrong(name, format!("{found:?}"), format!("{shape:?}")));
        }
        if !info.layout.is_contiguous() || info.layout.start_offset() != 0 {
            let expected = "one that lies in order; save it again as .contiguous()".to_owned();
            return Err(self.wrong(name, "a view, or not contiguous".to_owned(), expected));
        }
        if !matches!(info.dtype, DType::F32 | DType::F16 | DType::BF16 | DType::F64) {
            return Err(self.wrong(name, format!("{:?}", info.dtype), "floating-point numbers".to_owned()));
        }
        // A shape that the file cannot hold is not made room for.
        let bytes = shape
            .iter()
            .try_fold(info.dtype.size_in_bytes() as u64, |all, side| all.checked_mul(*side as u64));
        if bytes.is_none_or(|bytes| bytes > self.bytes) {
            return Err(self.wrong(
                name,
                format!("{found:?}"),
                format!("no more than the file's {} bytes", self.bytes),
            ));
        }
        let there = &self.names[name];
        let read = without_panic(|| self.tensors.get(there)).and_then(|tensor| {
            let tensor = tensor.ok_or_else(|| format!("it has no tensor {name}"))?;
            tensor.to_dtype(DType::F32).map_err(|error| error.to_string())
        });
        read.map_err(|reason| ImportError::Unreadable {
            path: self.path.clone(),
            reason: format!("{name}: {reason}"),
        })
    }
}

/// What a reader gives, or why it gave up, on one line.
/// The description of the file's objects, where it can be had: what is wrong otherwise, the reader says.
fn pickle_of(path: &Path) -> Option<Vec<u8>> {
    const PICKLE_BYTES_MAX: u64 = 64 << 20;
    let mut archive = zip::ZipArchive::new(std::fs::File::open(path).ok()?).ok()?;
    let name = archive.file_names().find(|name| name.ends_with("data.pkl"))?.to_owned();
    let mut bytes = Vec::new();
    archive.by_name(&name).ok()?.take(PICKLE_BYTES_MAX).read_to_end(&mut bytes).ok()?;
    Some(bytes)
}

/// The hook for panics is the process's: one at a time.
static HOOK: Mutex<()> = Mutex::new(());

fn without_panic<T>(read: impl FnOnce() -> candle_core::Result<T>) -> Result<T, String> {
    let _one = HOOK.lock().unwrap_or_else(PoisonError::into_inner);
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| {}));
    let result = catch_unwind(AssertUnwindSafe(read));
    std::panic::set_hook(hook);
    match result {
        Ok(Ok(found)) => Ok(found),
        Ok(Err(error)) => Err(error.to_string().lines().next().unwrap_or_default().to_owned()),
        Err(_) => Err("its structure is damaged".to_owned()),
    }
}
