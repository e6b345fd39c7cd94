//! Bundles that must be refused.

use std::path::{Path, PathBuf};

use anyhow::Context;
use prost::Message;
use rcwm_models::bundle::{Bundle, MANIFEST_FILE, Manifest, PartName};
use rcwm_models::files::sha256_hex;
use rcwm_models::onnx::{Model, data_type};
use rcwm_models::tensors::Values;

/// Folders with what is wrong in them.
pub(crate) struct BadBundles(Vec<(&'static str, PathBuf)>);

impl BadBundles {
    /// Makes one of each kind from a sound bundle.
    pub(crate) fn make(sound: &Path, folder: &Path) -> anyhow::Result<Self> {
        let bundle = Bundle::open(sound)?;
        let kinds: [(&str, Change); 4] = [
            ("flipped bit", flip_a_bit),
            ("NaN weight", poison),
            ("golden values", miss_golden),
            ("other sizes", grow),
        ];
        let made = kinds.into_iter().map(|(name, change)| {
            let to = folder.join(name.replace(' ', "-"));
            std::fs::create_dir(&to)?;
            for entry in std::fs::read_dir(sound)? {
                let entry = entry?;
                std::fs::copy(entry.path(), to.join(entry.file_name()))?;
            }
            let mut manifest = bundle.manifest.clone();
            change(&bundle, &to, &mut manifest).context(name)?;
            std::fs::write(to.join(MANIFEST_FILE), toml::to_string(&manifest)?)?;
            Ok((name, to))
        });
        Ok(Self(made.collect::<anyhow::Result<_>>()?))
    }

    pub(crate) fn of_round(&self, round: u32) -> (&'static str, &Path) {
        let (name, folder) = &self.0[round as usize % self.0.len()];
        (name, folder)
    }
}

type Change = fn(&Bundle, &Path, &mut Manifest) -> anyhow::Result<()>;

fn flip_a_bit(bundle: &Bundle, to: &Path, _: &mut Manifest) -> anyhow::Result<()> {
    let mut bytes = bundle.part(PartName::Robot).context("a robot")?.to_vec();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    Ok(std::fs::write(to.join("robot.onnx"), bytes)?)
}

fn poison(bundle: &Bundle, to: &Path, manifest: &mut Manifest) -> anyhow::Result<()> {
    let mut model = Model::decode(bundle.part(PartName::Actor).context("an actor")?)?;
    let constants = model.graph.iter_mut().flat_map(|graph| &mut graph.initializer);
    let weight =
        constants.into_iter().find(|tensor| tensor.data_type == data_type::FLOAT && tensor.dims.len() > 1);
    weight.context("a weight")?.raw_data[..4].copy_from_slice(&f32::NAN.to_le_bytes());
    let bytes = model.encode_to_vec();
    let entry = manifest.parts.iter_mut().find(|entry| entry.name == PartName::Actor).context("an actor")?;
    (entry.bytes, entry.sha256) = (bytes.len() as u64, sha256_hex(&bytes));
    Ok(std::fs::write(to.join(&entry.file), bytes)?)
}

fn miss_golden(bundle: &Bundle, to: &Path, manifest: &mut Manifest) -> anyhow::Result<()> {
    let mut golden = bundle.golden.clone();
    let Some(Values::F32(mean)) = golden.0.get_mut("expect/actor/mean") else {
        anyhow::bail!("no golden mean")
    };
    mean.mapv_inplace(|value| value + 0.01);
    let bytes = golden.to_bytes()?;
    (manifest.golden.bytes, manifest.golden.sha256) = (bytes.len() as u64, sha256_hex(&bytes));
    Ok(std::fs::write(to.join(&manifest.golden.file), bytes)?)
}

fn grow(_: &Bundle, _: &Path, manifest: &mut Manifest) -> anyhow::Result<()> {
    manifest.model.as_mut().context("a world model")?.deter *= 2;
    Ok(())
}
