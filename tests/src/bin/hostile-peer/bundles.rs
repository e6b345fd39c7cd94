//! The bundles of a run: what was given, with narrow, one-sided and wide limits, and some that are not as they look.

use std::path::{Path, PathBuf};

use anyhow::Context;
use prost::Message;
use rcwm_models::bundle::{ActionMode, Bundle, MANIFEST_FILE, Manifest, PartName};
use rcwm_models::files::sha256_hex;
use rcwm_models::onnx::{Attribute, Model, Node, Tensor, attribute_type};
use rcwm_runtime::policy::ActionLimits;
use rcwm_tests::faults::poisoned_bundle;

/// A bundle as the judge must know it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Known {
    pub(crate) limits: ActionLimits,
    /// Its policy never fails.
    pub(crate) is_sound: bool,
    /// Its actions are positions: zeros are no rest.
    pub(crate) is_absolute: bool,
}

/// A bundle that the controller may run, or be asked to swap to.
pub(crate) struct Choice {
    pub(crate) name: &'static str,
    pub(crate) folder: PathBuf,
    /// What was read of it; none where the runtime refuses it.
    pub(crate) bundle: Option<Bundle>,
    /// Its policy never fails.
    pub(crate) is_sound: bool,
}

impl Choice {
    /// What the judge must know; none where the runtime refuses it.
    pub(crate) fn known(&self) -> Option<Known> {
        let control = &self.bundle.as_ref()?.manifest.control;
        Some(Known {
            limits: ActionLimits::of(control),
            is_sound: self.is_sound,
            is_absolute: control.action_mode == ActionMode::Absolute,
        })
    }
}

/// All bundles, and the folder that holds their files.
pub(crate) struct Bundles {
    pub(crate) all: Vec<Choice>,
    _folders: Vec<tempfile::TempDir>,
}

impl Bundles {
    pub(crate) fn make(source: &Path) -> anyhow::Result<Self> {
        let one_sided = ([0.25, -0.001, -1.0, -1.0], [0.5, 0.001, -0.75, -0.9]);
        let limits = [
            ("as given", None, false),
            ("narrow", Some(([-0.2; 4], [0.2; 4])), false),
            ("one-sided", Some(one_sided), false),
            ("positions", None, true),
            ("narrow positions", Some(([-0.2; 4], [0.2; 4])), true),
            ("too wide", Some(([-100.0; 4], [100.0; 4])), false),
        ];
        let (mut all, mut folders) = (Vec::new(), Vec::new());
        let mut add = |name: &'static str, folder: tempfile::TempDir, is_sound: bool| {
            let bundle = Bundle::open(folder.path()).ok();
            all.push(Choice { name, folder: folder.path().to_path_buf(), bundle, is_sound });
            folders.push(folder);
        };
        for (name, limits, is_absolute) in limits {
            let folder = changed(source, |manifest, _| {
                if let Some((low, high)) = limits {
                    (manifest.control.action_low, manifest.control.action_high) =
                        (low.to_vec(), high.to_vec());
                }
                if is_absolute {
                    manifest.control.action_mode = ActionMode::Absolute;
                }
                Ok(())
            })?;
            add(name, folder, true);
        }
        add("NaN now and then", poisoned_bundle(), false);
        add("classes that jump", changed(source, jumping)?, false);
        anyhow::ensure!(all[0].bundle.is_some(), "{}: the runtime refuses it", source.display());
        Ok(Self { all, _folders: folders })
    }

    /// The bundle to start with: one that is refused gives way to the first.
    pub(crate) fn to_start(&self, number: usize) -> (&Choice, &Bundle) {
        let chosen = &self.all[number % self.all.len()];
        let first = &self.all[0];
        match (&chosen.bundle, &first.bundle) {
            (Some(bundle), _) => (chosen, bundle),
            (None, Some(bundle)) => (first, bundle),
            (None, None) => unreachable!("the first is sound"),
        }
    }
}

/// A copy with a changed manifest.
fn changed(
    source: &Path,
    change: impl FnOnce(&mut Manifest, &Path) -> anyhow::Result<()>,
) -> anyhow::Result<tempfile::TempDir> {
    let copy = tempfile::tempdir()?;
    for entry in std::fs::read_dir(source).with_context(|| source.display().to_string())? {
        let entry = entry?;
        std::fs::copy(entry.path(), copy.path().join(entry.file_name()))?;
    }
    let path = copy.path().join(MANIFEST_FILE);
    let mut manifest: Manifest = toml::from_str(&std::fs::read_to_string(&path)?)?;
    change(&mut manifest, copy.path())?;
    std::fs::write(path, toml::to_string(&manifest)?)?;
    Ok(copy)
}

/// The robot's prior classes are a million too large after an action whose first component is above 0.97. No golden value is.
fn jumping(manifest: &mut Manifest, folder: &Path) -> anyhow::Result<()> {
    let entry = manifest.parts.iter_mut().find(|entry| entry.name == PartName::Robot);
    let entry = entry.context("a required part")?;
    let path = folder.join(&entry.file);
    let mut model = Model::decode(&*std::fs::read(&path)?)?;
    let graph = model.graph.as_mut().context("a model has a graph")?;
    for node in &mut graph.node {
        let names = node.input.iter_mut().chain(&mut node.output);
        names.filter(|name| *name == "prior_z").for_each(|name| "clean_prior_z".clone_into(name));
    }
    // [0, a0] - [0, 0.97], whose argmax is 1 from there on.
    graph.initializer.push(Tensor::f32("jump_first", &[4, 2], &[0., 1., 0., 0., 0., 0., 0., 0.]));
    graph.initializer.push(Tensor::f32("jump_from", &[1, 2], &[0.0, 0.97]));
    graph.initializer.push(Tensor::i64("jump_by", &[2], &[0, 1_000_000]));
    let mut add = |op: &str, inputs: [&str; 2], output: &str, attributes: &[(&str, i64)]| {
        let attribute = |(name, i): &(&str, i64)| Attribute {
            name: (*name).to_owned(),
            i: *i,
            r#type: attribute_type::INT,
            ..Attribute::default()
        };
        graph.node.push(Node {
            op_type: op.into(),
            input: inputs.iter().filter(|name| !name.is_empty()).map(|name| (*name).to_owned()).collect(),
            output: vec![output.into()],
            name: format!("jump_{op}"),
            attribute: attributes.iter().map(attribute).collect(),
            ..Node::default()
        });
    };
    add("MatMul", ["action", "jump_first"], "jump_pair", &[]);
    add("Sub", ["jump_pair", "jump_from"], "jump_above", &[]);
    add("ArgMax", ["jump_above", ""], "jump_which", &[("axis", 1), ("keepdims", 1)]);
    add("Gather", ["jump_by", "jump_which"], "jump_amount", &[("axis", 0)]);
    add("Add", ["clean_prior_z", "jump_amount"], "prior_z", &[]);
    let bytes = model.encode_to_vec();
    (entry.bytes, entry.sha256) = (bytes.len() as u64, sha256_hex(&bytes));
    std::fs::write(path, bytes)?;
    Ok(())
}
