//! `metrics.jsonl` as a picture.

use std::path::Path;

use rcwm_models::files::read_capped;
use serde::Deserialize;

use super::TrainingError;
use crate::plots::{self, COLOURS, Line, Mark, Panel, Scale};

/// Largest file of metrics that is read back, in bytes.
pub const METRICS_BYTES_MAX: u64 = 1 << 30;
/// Pixels of one panel.
const PANEL: (u32, u32) = (460, 300);
const COLUMNS: usize = 4;
/// Points of a smoothed line, at most; more could not be told apart.
const SMOOTHED_POINTS: usize = 60;
/// Points of what is behind it, at most.
const RAW_POINTS: usize = 2000;

/// What a line of metrics may hold; what is not drawn is passed over.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Row {
    update: u64,
    phase: String,
    losses: Option<Losses>,
    held_out: Option<Losses>,
    cloning: Option<Cloning>,
    gradient_norm: Option<f64>,
    updates_per_second: Option<f64>,
}

/// The actor's own updates.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Cloning {
    loss: Option<f64>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Losses {
    total: Option<f64>,
    image: Option<f64>,
    robot_mask: Option<f64>,
    state_loss: Option<f64>,
    reward: Option<f64>,
    robot_kl: Option<f64>,
    environment_kl: Option<f64>,
    cloning: Option<f64>,
}

type OfLosses = fn(&Losses) -> Option<f64>;

const MASK: &str = "robot mask, squared error summed";
const STATE: &str = "measured state, squared error of symlog summed";
const CLONING: &str = "cloning, squared error summed";

const LOSSES: [(&str, OfLosses); 8] = [
    ("total loss", |losses| losses.total),
    ("image, squared error summed over pixels", |losses| losses.image),
    (MASK, |losses| losses.robot_mask),
    (STATE, |losses| losses.state_loss),
    (CLONING, |losses| losses.cloning),
    ("reward, cross-entropy (nats)", |losses| losses.reward),
    ("KL robot (nats)", |losses| losses.robot_kl),
    ("KL environment (nats)", |losses| losses.environment_kl),
];

/// Draws the metrics in `metrics` into the picture `curves`, whole or not at all. `warm_up_updates` is where masks end.
///
/// # Errors
/// Those of reading, drawing and writing.
pub(super) fn write(metrics: &Path, curves: &Path, warm_up_updates: u64) -> Result<(), TrainingError> {
    let text = read_capped(metrics, METRICS_BYTES_MAX)?;
    // A line that cannot be read is one that is just being written.
    let rows: Vec<Row> =
        String::from_utf8_lossy(&text).lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
    Ok(plots::write_png(&plots::draw(&panels(&rows, warm_up_updates), COLUMNS, PANEL)?, curves)?)
}

fn panels(rows: &[Row], warm_up_updates: u64) -> Vec<Panel> {
    let end = rows.iter().map(|row| row.update).max().unwrap_or(0);
    let warm_up_ends = (1..end).contains(&warm_up_updates);
    let marks = || {
        let mark = Mark { x: warm_up_updates as f64, label: "mask-free".to_owned() };
        if warm_up_ends { vec![mark] } else { Vec::new() }
    };
    let panel = |title: &str, scale, lines| Panel {
        title: title.to_owned(),
        x_label: "updates".to_owned(),
        scale,
        lines,
        marks: marks(),
    };
    // A run has masks or demonstrations: the panel of the other would be empty.
    let demonstrated = rows.iter().any(|row| clones(row).is_some());
    let mut panels: Vec<Panel> = LOSSES
        .iter()
        .filter(|(title, _)| *title != if demonstrated { MASK } else { CLONING })
        .filter(|(title, of)| {
            *title != STATE || rows.iter().any(|row| row.losses.as_ref().and_then(of).is_some())
        })
        .map(|(title, of)| {
            let trained = match *title {
                CLONING => points(rows, clones),
                _ => points(rows, |row| row.losses.as_ref().and_then(of)),
            };
            let held_out = points(rows, |row| row.held_out.as_ref().and_then(of));
            let mut lines = smoothed("trained on", COLOURS[0], trained, warm_up_updates);
            if !held_out.is_empty() {
                lines.push(line("held out", COLOURS[1], held_out, false));
            }
            panel(title, Scale::Log, lines)
        })
        .collect();
    for (title, scale, of) in [
        ("gradient norm before clipping", Scale::Log, (|row| row.gradient_norm) as fn(&Row) -> Option<f64>),
        ("updates a second", Scale::Linear, |row| row.updates_per_second),
    ] {
        panels.push(panel(title, scale, smoothed("", COLOURS[0], points(rows, of), warm_up_updates)));
    }
    panels
}

/// The cloning loss of an update, of whichever stage.
fn clones(row: &Row) -> Option<f64> {
    let own = row.cloning.as_ref().and_then(|cloning| cloning.loss);
    own.or_else(|| row.losses.as_ref().and_then(|losses| losses.cloning))
}

fn points(rows: &[Row], of: impl Fn(&Row) -> Option<f64>) -> Vec<(f64, f64)> {
    rows.iter().filter_map(|row| Some((row.update as f64, of(row)?))).collect()
}

fn line(label: &str, colour: plots::Colour, points: Vec<(f64, f64)>, faint: bool) -> Line {
    Line { label: label.to_owned(), colour, points, band: None, faint }
}

/// The points as a faint line, and means of neighbours over it; never of points on both sides of the warm-up's end.
fn smoothed(label: &str, colour: plots::Colour, points: Vec<(f64, f64)>, warm_up_updates: u64) -> Vec<Line> {
    let split = points.partition_point(|(update, _)| *update <= warm_up_updates as f64);
    let group = points.len().div_ceil(SMOOTHED_POINTS).max(1);
    let mean = |group: &[(f64, f64)]| {
        let sum = group.iter().fold((0.0, 0.0), |sum, point| (sum.0 + point.0, sum.1 + point.1));
        (sum.0 / group.len() as f64, sum.1 / group.len() as f64)
    };
    let (before, after) = points.split_at(split);
    let means: Vec<_> = before.chunks(group).chain(after.chunks(group)).map(mean).collect();
    let every = points.len().div_ceil(RAW_POINTS).max(1);
    let raw = points.into_iter().step_by(every).collect();
    vec![line(label, colour, raw, true), line(label, colour, means, false)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curves_show_what_the_lines_say_and_pass_over_half_a_line() {
        let folder = tempfile::tempdir().unwrap();
        let (metrics, curves) = (folder.path().join("metrics.jsonl"), folder.path().join("curves.png"));
        let mut text = String::new();
        for update in (20..=4000).step_by(20) {
            let (phase, mask) =
                if update <= 1000 { ("warm_up", r#","robot_mask":30.0"#) } else { ("mask_free", "") };
            let total = 2e5 / f64::from(update);
            text += &format!(
                r#"{{"update":{update},"phase":"{phase}","losses":{{"total":{total},"image":{total}{mask},"reward":4.0,"robot_kl":3.0}},"gradient_norm":9.0,"updates_per_second":2.5}}"#
            );
            text.push('\n');
        }
        text += "{\"update\":2000,\"held_out\":{\"total\":70.0}}\n{\"upda";
        std::fs::write(&metrics, text).unwrap();
        write(&metrics, &curves, 1000).unwrap();
        let picture = image::open(&curves).unwrap().into_rgb8();
        assert_eq!(picture.dimensions(), (4 * PANEL.0, 2 * PANEL.1));
        let count = |colour: plots::Colour, column: u32, row: u32| {
            let inside =
                |x: u32, y: u32| picture.get_pixel(column * PANEL.0 + x, row * PANEL.1 + y).0 == colour;
            (0..PANEL.0 * PANEL.1).filter(|index| inside(index % PANEL.0, index / PANEL.0)).count()
        };
        assert!(count(COLOURS[0], 0, 0) > 300, "the total loss is drawn");
        assert!(count(COLOURS[1], 0, 0) > 10, "the held-out loss is a dot");
        assert_eq!(count(COLOURS[0], 1, 1), 0, "a model with one branch has one KL");
    }

    #[test]
    fn means_do_not_mix_the_phases() {
        let points =
            (1..=400).map(|update| (f64::from(update), if update <= 10 { 1.0 } else { 5.0 })).collect();
        let lines = smoothed("", COLOURS[0], points, 10);
        assert!(lines[1].points.iter().all(|(_, value)| *value == 1.0 || *value == 5.0));
        assert!(lines[1].points.len() <= SMOOTHED_POINTS + 2);
    }
}
