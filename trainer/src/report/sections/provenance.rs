use std::collections::BTreeMap;

use maud::{Markup, html};
use rcwm_models::settings::{ModelKind, ModelSettings};

use crate::report::html::{Column, table, words};
use crate::report::{Provenance, Report};

/// Command line, machine, models and parts.
pub(super) fn section(report: &Report) -> Markup {
    html! {
        p { "The page was drawn by" }
        pre { code { (report.command) } }
        p {
            "Every part says itself when, where and from what it was measured; what was there already was not measured again. "
            code { "report.json" } " beside this page holds every number."
        }
        h3 { "Models" } (models(report))
        h3 { "Parts" } (parts(report))
        (files(report))
    }
}

/// Checkpoints and bundles by their checksums.
fn models(report: &Report) -> Markup {
    let mut rows = BTreeMap::new();
    for part in &report.dynamics {
        let checkpoint = &part.measured.checkpoint;
        rows.entry((&part.source.weights_sha256, "checkpoint")).or_insert_with(|| {
            let told =
                (&checkpoint.preset, checkpoint.updates, checkpoint.seed.to_string(), &checkpoint.data);
            model(part.source.model.clone(), &part.source.weights_sha256, &checkpoint.model, told)
        });
    }
    for part in &report.success {
        let provenance = &part.measured.provenance;
        rows.entry((&part.source.bundle_sha256, "bundle")).or_insert_with(|| {
            let seeds = provenance.seeds.iter().map(u64::to_string).collect::<Vec<_>>().join(", ");
            let name = format!("{} ({})", part.source.policy, part.source.task);
            let told = (&provenance.preset, provenance.updates, seeds, &provenance.data);
            model(name, &part.source.bundle_sha256, &part.measured.model, told)
        });
    }
    if rows.is_empty() {
        return html! { p.none { "None." } };
    }
    let columns = [
        Column::Words("model"),
        Column::Words("kind"),
        Column::Words("preset"),
        Column::Number("updates"),
        Column::Words("seed"),
        Column::Words("sizes"),
        Column::Words("trained on"),
        Column::Words("sha256"),
    ];
    table(&columns, &rows.into_values().collect::<Vec<_>>())
}

fn model(
    name: String,
    sha256: &str,
    model: &ModelSettings,
    (preset, updates, seeds, data): (&String, u64, String, &String),
) -> Vec<Option<Markup>> {
    let kind = match model.kind {
        ModelKind::Rcwm => "RCWM",
        ModelKind::Vanilla => "vanilla",
    };
    let ModelSettings { cnn_depth, categoricals, classes, deter, hidden, units, .. } = model;
    let sizes = format!(
        "{categoricals} × {classes} latents, h {deter}, hidden {hidden}, units {units}, depth {cnn_depth}"
    );
    let start = sha256.get(..12).unwrap_or(sha256);
    vec![
        words(name),
        words(kind),
        words(preset),
        words(updates.to_string()),
        words(seeds),
        words(sizes),
        words(data),
        Some(html! { code { (start) } }),
    ]
}

/// What was measured when, where and how.
fn parts(report: &Report) -> Markup {
    let mut rows = Vec::new();
    for part in &report.success {
        let s = &part.source;
        let sampled = if s.sampled_by.is_some() { "drawn" } else { "mode" };
        let what = format!("success of {} on {}, disturbance {}", s.policy, s.task, s.disturb);
        let how = format!(
            "{} episodes of at most {} steps, seed {}, engine {}, latents and actions: {sampled}",
            s.episodes, s.steps_max, s.seed, s.engine
        );
        rows.push(row(what, how, &part.made, part.seconds));
    }
    for part in &report.dynamics {
        let (s, o) = (&part.source, &part.source.settings);
        let what = format!("dynamics of {} on {}, disturbance {}", s.model, s.task, s.disturb);
        let how = format!(
            "{} trajectories, {} steps seen, {} imagined, seed {}, latents: {}",
            part.measured.report.trajectories,
            o.context,
            o.imagined,
            o.seed,
            o.latents.name()
        );
        rows.push(row(what, how, &part.made, part.seconds));
    }
    for part in &report.attention {
        let what = format!("attention of {} on {}", part.source.model, part.source.task);
        let how = format!("seed {}, latents: {}", part.source.seed, part.source.latents.name());
        rows.push(row(what, how, &part.made, part.seconds));
    }
    if rows.is_empty() {
        return html! { p.none { "None." } };
    }
    let columns = [
        Column::Words("part"),
        Column::Words("how"),
        Column::Words("measured"),
        Column::Number("seconds"),
        Column::Words("machine"),
    ];
    table(&columns, &rows)
}

fn row(what: String, how: String, made: &Provenance, seconds: f64) -> Vec<Option<Markup>> {
    let machine = format!(
        "{}, {} cores, {}; version {} ({})",
        made.processor, made.cores, made.device, made.version, made.revision
    );
    vec![words(what), words(how), words(&made.date), words(format!("{seconds:.1}")), words(machine)]
}

/// The result files that were given.
fn files(report: &Report) -> Markup {
    let entries: Vec<_> = report.results.iter().flat_map(|part| &part.measured.entries).collect();
    if entries.is_empty() {
        return html! {};
    }
    let columns = [
        Column::Words("label"),
        Column::Words("policy"),
        Column::Words("task"),
        Column::Words("disturbance"),
        Column::Number("success"),
        Column::Number("seed of layouts"),
    ];
    let rows: Vec<_> = entries
        .into_iter()
        .map(|entry| {
            vec![
                words(&entry.label),
                words(&entry.of),
                words(&entry.task),
                words(&entry.disturb),
                words(format!("{} of {}", entry.successes, entry.episodes)),
                words(entry.seed.to_string()),
            ]
        })
        .collect();
    html! { h3 { "Result files" } (table(&columns, &rows)) }
}
