//! A bundle of kind `recurrent` from an ONNX file of any library: names, shapes and sizes checked against a robot, golden values
//! recorded, and the finished folder opened and verified as a runtime would.

mod adapt;
mod golden;

use std::path::{Path, PathBuf};

use ndarray::{ArrayD, IxDyn};
use prost::Message;
use rcwm_models::bundle::{
    Bundle, BundleError, BundleKind, DType, FORMAT, FileEntry, Manifest, NewBundle, PART_BYTES_MAX,
    PartEntry, PartName, PolicyInputs, PolicySignature, Provenance, TensorSpec, WriteError,
};
use rcwm_models::files::{FileError, read_capped, sha256_hex};
use rcwm_models::interface::Interface;
use rcwm_models::onnx::{self, OnnxError};
use rcwm_models::tensors::{Tensors, TensorsError, Values};
use rcwm_runtime::engine::{EngineError, EngineKind, EngineSettings};
use rcwm_runtime::policy::PolicyError;
use rcwm_runtime::verify::{VerifyError, verify};

/// Largest file of initial states or golden values read, in bytes.
const TENSORS_BYTES_MAX: u64 = 32 << 20;
/// Largest error of an output against its golden values.
const TOLERANCE: f32 = 1e-5;
/// By how much an action may be beyond -1 and 1, for rounding.
const BEYOND_ONE: f32 = 1e-3;

/// Why there is no bundle.
#[derive(Debug, thiserror::Error)]
pub enum BundlingError {
    /// A file could not be read.
    #[error(transparent)]
    File(#[from] FileError),
    /// The file is not the ONNX that a runtime runs.
    #[error("{path}: {source}")]
    Onnx { path: PathBuf, source: OnnxError },
    /// A name was to be changed that the graph does not have.
    #[error("{option} {name}: the graph has no such {role}; it has {known}")]
    Unknown { option: &'static str, name: String, role: &'static str, known: String },
    /// An input or output whose size is not known.
    #[error(
        "{role} {name:?} has a size that is not fixed, or no type; export with a batch of 1 and fixed sizes, without dynamic axes"
    )]
    NotFixed { role: &'static str, name: String },
    /// Inputs or outputs are not what the robot gives and takes.
    #[error(
        "{path}: {source}; the robot offers {offers}; --rename FROM=TO gives other names, --carry IN=OUT carries an output on"
    )]
    DoesNotFit { path: PathBuf, source: Box<BundleError>, offers: String },
    /// Initial states or golden values are unusable.
    #[error("{path}: {source}")]
    Tensors { path: PathBuf, source: TensorsError },
    /// There is nothing to hold the policy against.
    #[error(
        "golden values are missing: {0}. Or give the policy's own with --golden FILE: without either, an engine would be held against \
         itself"
    )]
    NoGolden(EngineError),
    /// The policy's actions are no shares of the limits.
    #[error(
        "{path}: the action reaches {found}, expected -1 to 1, from the interface's low to its high; normalise it, or end the graph with \
         Tanh or Clip"
    )]
    BeyondLimits { path: PathBuf, found: f32 },
    /// The policy gives what is no number.
    #[error("{path}: {name} is not finite at tick {tick} of the made-up ticks")]
    NotFinite { path: PathBuf, name: String, tick: usize },
    /// A new name that another value has.
    #[error(
        "--rename {from}={to}: the graph has a value {to:?} already; rename that one first, or choose another name"
    )]
    NameTaken { from: String, to: String },
    /// The policy does not run on what it would be given.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// The golden values are unusable.
    #[error(transparent)]
    Verify(#[from] VerifyError),
    /// The runtime computes something else.
    #[error("golden values are missed: {0}")]
    Missed(String),
    /// The folder could not be written.
    #[error(transparent)]
    Write(#[from] WriteError),
}

/// What is wanted.
#[derive(Debug, Clone)]
pub struct Request {
    /// The policy.
    pub onnx: PathBuf,
    /// The robot that it is for.
    pub interface: Interface,
    /// Cameras and states that it reads, in its order; none: what the graph's inputs name, and all states.
    pub inputs: Option<Vec<String>>,
    /// New names of inputs and outputs.
    pub rename: Vec<(String, String)>,
    /// Pairs of an input and the output that is fed to it at the next tick.
    pub carry: Vec<(String, String)>,
    /// What is carried into the first tick of an episode (safetensors, by the names in the bundle); none: zeros.
    pub initial: Option<PathBuf>,
    /// Golden values of the library that the policy comes from; none: recorded here.
    pub golden: Option<PathBuf>,
    /// Ticks of golden values that are recorded here.
    pub golden_ticks: usize,
    pub task: String,
    /// Whether a bundle that is there is replaced.
    pub replace: bool,
}

/// Builds the bundle at `place`.
///
/// # Errors
/// See [`BundlingError`]; `place` is then as it was before.
pub fn build(request: &Request, place: &Path) -> Result<Bundle, BundlingError> {
    let bytes = read_capped(&request.onnx, PART_BYTES_MAX)?;
    let of_file = |source| BundlingError::Onnx { path: request.onnx.clone(), source };
    let mut model = onnx::parse_self_contained(&bytes).map_err(of_file)?;
    let graph = model.graph.as_mut().ok_or_else(|| of_file(OnnxError::NoGraph))?;
    adapt::rename(graph, request)?;
    let [inputs, outputs] = adapt::border(graph)?;
    let new = NewBundle::begin(place, request.replace)?;
    let FileEntry { file, bytes: size, sha256 } = new.file("policy.onnx", &model.encode_to_vec())?;
    let part = PartEntry { name: PartName::Policy, file, bytes: size, sha256, inputs, outputs };
    let policy = PolicyInputs { inputs: adapt::policy_inputs(request, &part), limits: None };
    // Which files they were, not where they lie on this machine.
    let name_of = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let name = name_of(&request.onnx);
    let provenance = Provenance {
        preset: "own".into(),
        data: format!("{name}, sha256 {}", sha256_hex(&bytes)),
        updates: 0,
        seeds: Vec::new(),
        source_revision: format!("{} {}", model.producer_name, model.producer_version).trim().to_owned(),
    };
    let empty = new.file("golden.safetensors", &to_bytes(&Tensors::default())?)?;
    let mut manifest = Manifest {
        format: FORMAT,
        kind: BundleKind::Recurrent,
        task: request.task.clone(),
        model: None,
        interface: request.interface.clone(),
        policy,
        provenance,
        initial: empty.clone(),
        golden: empty,
        parts: vec![part],
    };
    // Names and sizes are told before anything else.
    let does_not_fit = |source: BundleError| BundlingError::DoesNotFit {
        path: request.onnx.clone(),
        source: source.into(),
        offers: adapt::offers(&request.interface),
    };
    manifest.check().map_err(does_not_fit)?;
    let signature = PolicySignature::of(&manifest, &manifest.parts[0]).map_err(does_not_fit)?;
    manifest.initial = new.file("initial.safetensors", &to_bytes(&initial(request, &signature)?)?)?;
    let bundle = new.check(&manifest)?;
    let (golden, words) = match &request.golden {
        Some(path) => (read(path)?, format!("golden values: {}", name_of(path))),
        None => golden::record(&bundle, &request.onnx, request.golden_ticks)?,
    };
    if let Ok(actions) = golden.f32("expect/policy/action")
        && let Some(found) = actions.iter().find(|x| x.abs() > 1.0 + BEYOND_ONE)
    {
        return Err(BundlingError::BeyondLimits { path: request.onnx.clone(), found: *found });
    }
    manifest.provenance.data += &format!("; {words}");
    manifest.golden = new.file("golden.safetensors", &to_bytes(&golden)?)?;
    let bundle = new.check(&manifest)?;
    let deployed = EngineSettings::single_threaded(EngineKind::Tract);
    let report =
        verify(&bundle, deployed, TOLERANCE, &mut || {}).map_err(|error| match (error, &request.golden) {
            // The file that was given, not its copy.
            (VerifyError::Golden { source, .. }, Some(path)) => {
                BundlingError::Tensors { path: path.clone(), source }
            }
            (error, _) => error.into(),
        })?;
    if let Some(first) = report.failures.into_iter().next() {
        return Err(BundlingError::Missed(first));
    }
    Ok(new.finish()?)
}

/// What every episode starts from: as asked, or zeros.
fn initial(request: &Request, signature: &PolicySignature) -> Result<Tensors, BundlingError> {
    if let Some(path) = &request.initial {
        return read(path);
    }
    let zeros = |spec: &TensorSpec| (spec.name.clone(), Values::F32(ArrayD::zeros(IxDyn(&spec.shape))));
    Ok(Tensors(signature.carried.iter().map(zeros).collect()))
}

fn read(path: &Path) -> Result<Tensors, BundlingError> {
    let bytes = read_capped(path, TENSORS_BYTES_MAX)?;
    Tensors::of_few(&bytes).map_err(|source| BundlingError::Tensors { path: path.to_path_buf(), source })
}

fn to_bytes(tensors: &Tensors) -> Result<Vec<u8>, BundlingError> {
    let failed = |source| BundlingError::Tensors { path: "golden values".into(), source };
    tensors.to_bytes().map_err(failed)
}

/// Inputs or outputs for people.
#[must_use]
pub fn list(specs: &[TensorSpec]) -> String {
    let each = specs.iter().map(|spec| {
        let TensorSpec { name, dtype, shape } = spec;
        format!("{name} {} {shape:?}", DType::as_str(*dtype))
    });
    each.collect::<Vec<_>>().join(", ")
}
