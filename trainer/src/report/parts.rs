use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use rcwm_models::files::{read_capped, sha256_hex, write_atomic};
use rcwm_models::lock::Lock;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::{Provenance, ReportError};

/// Version of the parts' format.
const FORMAT: u32 = 1;
/// Largest part that is read, in bytes.
const PART_BYTES_MAX: u64 = 256 << 20;
/// Letters of a part's name that are kept.
const STEM_LETTERS: usize = 80;

/// Something that is measured and kept.
pub trait Measurement: Serialize + DeserializeOwned {
    /// How its files' names begin.
    const KIND: &'static str;
    /// What it is measured from.
    type Source: Serialize + DeserializeOwned + PartialEq;

    /// What it is called. A part with the same names takes its place.
    fn names(source: &Self::Source) -> Vec<&str>;
}

/// Something that was measured, with all that is known of how.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(bound(serialize = "M: Measurement", deserialize = "M: Measurement"))]
pub struct Part<M: Measurement> {
    /// Version of the format.
    pub format: u32,
    /// What it was measured from.
    pub source: M::Source,
    /// When and where.
    pub made: Provenance,
    /// How long it took.
    pub seconds: f64,
    /// File names of its pictures.
    pub pictures: Vec<String>,
    /// What was found.
    pub measured: M,
}

/// The folder with the parts of a report.
#[derive(Debug, Clone)]
pub struct Store {
    folder: PathBuf,
    /// Nobody else measures here.
    _lock: Arc<Lock>,
}

/// A part that is being made: where its pictures go.
#[derive(Debug)]
pub struct Draft {
    folder: PathBuf,
    stem: String,
    /// Pictures of another source have other names, so that a part always has its own.
    digest: String,
    pictures: Vec<String>,
}

impl Draft {
    /// How many pictures it has.
    #[must_use]
    pub fn pictures(&self) -> usize {
        self.pictures.len()
    }

    /// Where to write a picture, whose name is kept with the part.
    pub fn picture(&mut self, name: &str) -> PathBuf {
        let file = format!("{}.{}.{name}", self.stem, self.digest);
        let path = self.folder.join(&file);
        self.pictures.push(file);
        path
    }
}

impl Store {
    /// The parts of the report in this folder; both are made where they are missing.
    ///
    /// # Errors
    /// [`ReportError::Folder`], or [`ReportError::Lock`] where somebody else measures for the same report.
    pub fn open(report: &Path) -> Result<Self, ReportError> {
        let folder = report.join("parts");
        fs::create_dir_all(&folder).map_err(|source| ReportError::Folder { path: folder.clone(), source })?;
        let lock = Arc::new(Lock::take(&folder)?);
        Ok(Self { folder, _lock: lock })
    }

    /// The part with this source, whole with its pictures; none if there is none, it is of another source, or cannot be read.
    pub fn find<M: Measurement>(&self, source: &M::Source) -> Option<Part<M>> {
        let part: Part<M> = read(&self.file::<M>(source)).ok()?;
        let whole = part.pictures.iter().all(|picture| self.picture(picture).is_file());
        (part.format == FORMAT && whole && part.source == *source).then_some(part)
    }

    /// Begins a part.
    ///
    /// # Errors
    /// [`ReportError::Json`].
    pub fn draft<M: Measurement>(&self, source: &M::Source) -> Result<Draft, ReportError> {
        let text = serde_json::to_vec(source).map_err(ReportError::Json)?;
        let digest = sha256_hex(&text)[..8].to_owned();
        Ok(Draft { folder: self.folder.clone(), stem: stem::<M>(source), digest, pictures: Vec::new() })
    }

    /// Keeps what was measured: the part's file is written last, and then what an older one had is removed.
    ///
    /// # Errors
    /// [`ReportError::Json`], [`ReportError::File`] or [`ReportError::Folder`].
    pub fn keep<M: Measurement>(
        &self,
        draft: Draft,
        source: M::Source,
        measured: M,
        made: Provenance,
        seconds: f64,
    ) -> Result<(), ReportError> {
        let file = self.file::<M>(&source);
        let part = Part { format: FORMAT, source, made, seconds, pictures: draft.pictures, measured };
        let mut text = serde_json::to_vec_pretty(&part).map_err(ReportError::Json)?;
        text.push(b'\n');
        write_atomic(&file, &text)?;
        let old = format!("{}.", draft.stem);
        for path in self.files()? {
            let name = name_of(&path);
            if path != file && name.starts_with(&old) && !part.pictures.contains(&name) {
                fs::remove_file(&path).map_err(|source| ReportError::Folder { path, source })?;
            }
        }
        Ok(())
    }

    /// All parts of a kind, in the order of their names.
    ///
    /// # Errors
    /// [`ReportError::Part`] if one cannot be read, or [`ReportError::Folder`].
    pub fn all<M: Measurement>(&self) -> Result<Vec<Part<M>>, ReportError> {
        let begin = format!("{}-", M::KIND);
        let is_part = |path: &PathBuf| {
            path.extension() == Some(OsStr::new("json")) && name_of(path).starts_with(&begin)
        };
        let files = self.files()?.into_iter().filter(is_part);
        files
            .map(|path| {
                let wrong = |reason| ReportError::Part { path: path.clone(), reason };
                let part: Part<M> = read(&path).map_err(wrong)?;
                if part.format != FORMAT {
                    return Err(wrong(format!("has format {}, this program reads {FORMAT}", part.format)));
                }
                Ok(part)
            })
            .collect()
    }

    /// Where a part's picture lies.
    #[must_use]
    pub fn picture(&self, file: &str) -> PathBuf {
        // A name, whatever the part says.
        self.folder.join(Path::new(file).file_name().unwrap_or_default())
    }

    fn file<M: Measurement>(&self, source: &M::Source) -> PathBuf {
        self.folder.join(format!("{}.json", stem::<M>(source)))
    }

    fn files(&self) -> Result<Vec<PathBuf>, ReportError> {
        let fail = |source| ReportError::Folder { path: self.folder.clone(), source };
        let entries = fs::read_dir(&self.folder).map_err(fail)?;
        let mut files: Vec<PathBuf> =
            entries.map(|entry| Ok(entry?.path())).collect::<std::io::Result<_>>().map_err(fail)?;
        files.sort();
        Ok(files)
    }
}

/// How the names of a part's files begin: readable, and another one for other names.
fn stem<M: Measurement>(source: &M::Source) -> String {
    let names = M::names(source);
    let plain = |letter: char| if letter.is_ascii_alphanumeric() { letter } else { '-' };
    let words: String =
        format!("{}-{}", M::KIND, names.join("-")).chars().map(plain).take(STEM_LETTERS).collect();
    let digest = sha256_hex(names.join("\n").as_bytes());
    format!("{words}-{}", &digest[..6])
}

fn read<M: Measurement>(path: &Path) -> Result<Part<M>, String> {
    let bytes = read_capped(path, PART_BYTES_MAX).map_err(|error| error.to_string())?;
    serde_json::from_slice(&bytes).map_err(|error| error.to_string())
}

fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    struct Height {
        metres: f64,
    }

    #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
    struct Ruler {
        name: String,
        length: u32,
    }

    impl Measurement for Height {
        const KIND: &'static str = "height";
        type Source = Ruler;

        fn names(source: &Ruler) -> Vec<&str> {
            vec![&source.name]
        }
    }

    fn ruler(name: &str, length: u32) -> Ruler {
        Ruler { name: name.to_owned(), length }
    }

    fn measure(store: &Store, source: &Ruler, metres: f64) {
        let mut draft = store.draft::<Height>(source).unwrap();
        fs::write(draft.picture("a.png"), b"picture").unwrap();
        store.keep(draft, source.clone(), Height { metres }, Provenance::now("cpu"), 0.1).unwrap();
    }

    #[test]
    fn a_part_is_found_again_only_for_what_it_was_measured_from() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        assert!(store.find::<Height>(&ruler("door", 1)).is_none());
        measure(&store, &ruler("door", 1), 2.0);
        assert_eq!(store.find::<Height>(&ruler("door", 1)).unwrap().measured.metres, 2.0);
        assert!(store.find::<Height>(&ruler("door", 2)).is_none(), "another ruler");
        assert!(store.find::<Height>(&ruler("wall", 1)).is_none(), "another thing");
        measure(&store, &ruler("door", 2), 2.1);
        let all = store.all::<Height>().unwrap();
        assert_eq!(all.len(), 1, "the new one took the old one's place");
        assert_eq!(all[0].source.length, 2);
        assert_eq!(fs::read_dir(folder.path().join("parts")).unwrap().count(), 2, "and its picture");
    }

    #[test]
    fn names_that_look_alike_are_told_apart() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        measure(&store, &ruler("a/b", 1), 1.0);
        measure(&store, &ruler("a-b", 1), 2.0);
        measure(&store, &ruler("../../x", 1), 3.0);
        assert_eq!(store.all::<Height>().unwrap().len(), 3);
        assert_eq!(store.find::<Height>(&ruler("a/b", 1)).unwrap().measured.metres, 1.0);
    }

    #[test]
    fn a_part_without_its_picture_is_measured_again_and_a_damaged_one_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        let source = ruler("door", 1);
        measure(&store, &source, 2.0);
        let part = store.find::<Height>(&source).unwrap();
        fs::remove_file(store.picture(&part.pictures[0])).unwrap();
        assert!(store.find::<Height>(&source).is_none());
        fs::write(store.file::<Height>(&source), b"{").unwrap();
        assert!(store.find::<Height>(&source).is_none());
        let text = store.all::<Height>().unwrap_err().to_string();
        assert!(text.contains("height-door") && text.contains("remove"), "{text}");
    }
}
