//! Our numbers are the authors' numbers.

#![allow(clippy::unwrap_used)]

mod support;

use assert_cmd::Command;
use candle_core::Device;
use rcwm_models::tensors::Values;
use rcwm_trainer::parity::{self, Group, ParityError, Reference};

fn reference() -> Reference {
    Reference::read(&support::reference_file()).unwrap()
}

fn change_one_weight(reference: &mut Reference, name: &str, change: f32) {
    let Some(Values::F32(array)) = reference.tensors.0.get_mut(name) else { panic!("{name} is missing") };
    let value = array.iter_mut().next().unwrap();
    *value += change;
}

#[test]
fn every_group_agrees_with_the_reference() {
    let report = parity::check(&reference(), &Group::ALL, &Device::Cpu, &mut |_| ()).unwrap();
    for group in &report.groups {
        assert!(group.passes(), "{:?}", group.worst());
    }
    let compared: usize = report.groups.iter().map(|group| group.comparisons.len()).sum();
    assert_eq!(compared, 308, "tensors compared");
}

#[test]
fn what_is_not_computed_is_listed_and_not_passed() {
    let report = parity::check(&reference(), &[Group::Encoder], &Device::Cpu, &mut |_| ()).unwrap();
    let left = |prefix: &str| {
        report
            .unchecked
            .iter()
            .find(|unchecked| unchecked.prefix == prefix)
            .map(|unchecked| unchecked.tensors)
    };
    assert_eq!(
        (left("encoder"), left("observe"), left("grad"), left("loss")),
        (None, Some(13), Some(106), Some(13))
    );
    assert!(!parity::check(&reference(), &[], &Device::Cpu, &mut |_| ()).unwrap().passes());
}

#[test]
fn one_changed_weight_of_any_part_fails_its_group() {
    for (weight, group) in [
        ("encoder.shared.0.conv.weight", Group::Encoder),
        ("robot.cell.linear.weight", Group::Observe),
        ("environment.initial", Group::Observe),
        ("interaction.key.weight", Group::Observe),
        ("decoder.environment.2.norm.bias", Group::Decode),
        ("heads.continue.out.bias", Group::Heads),
        ("actor.1.linear.weight", Group::Actor),
        ("critic.0.norm.weight", Group::Critic),
        ("robot.prior.logits.weight", Group::Imagine),
        ("heads.reward.0.linear.weight", Group::Behaviour),
    ] {
        let mut reference = reference();
        change_one_weight(&mut reference, &format!("weights/{weight}"), 0.02);
        let report = parity::check(&reference, &[group], &Device::Cpu, &mut |_| ()).unwrap();
        assert!(!report.passes(), "{weight} is not seen by {group:?}");
    }
}

#[test]
fn weights_that_are_not_finite_are_refused_by_name() {
    let mut reference = reference();
    change_one_weight(&mut reference, "weights/actor.out.bias", f32::NAN);
    match parity::check(&reference, &[Group::Actor], &Device::Cpu, &mut |_| ()) {
        Err(ParityError::Parameters(error)) => {
            assert!(error.to_string().contains("actor.out.bias"), "{error}")
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_reference_of_other_sizes_than_its_weights_is_refused() {
    let mut reference = reference();
    reference.settings.units = 33;
    assert!(matches!(
        parity::check(&reference, &[Group::Actor], &Device::Cpu, &mut |_| ()),
        Err(ParityError::Parameters(_))
    ));
}

#[test]
fn the_command_prints_the_groups_and_says_where_a_file_is_missing() {
    let command = || Command::new(env!("CARGO_BIN_EXE_rcwm-trainer"));
    let run = command().arg("parity").arg(support::reference_file()).assert().success();
    let text = String::from_utf8(run.get_output().stdout.clone()).unwrap();
    assert!(text.contains("imagine") && text.contains("behaviour_updated"), "{text}");
    let run = command().args(["parity", "no-such-file"]).assert().failure();
    let text = String::from_utf8(run.get_output().stderr.clone()).unwrap();
    assert!(text.contains("no-such-file") && text.lines().count() == 1, "{text}");
}
