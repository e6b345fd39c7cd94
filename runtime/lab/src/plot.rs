//! Latency by percentile as a picture. Both axes are logarithmic: the slowest of 10, 100, 1000 ticks stand one step apart.

use std::path::Path;
use std::sync::OnceLock;

use hdrhistogram::Histogram;
use plotters::coord::Shift;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;
use plotters::style::register_font;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use rcwm_models::files::{FileError, read_capped};
use rcwm_runtime::telemetry::{LatencyFiles, Stage, Telemetry};

use rcwm_models::picture::{PictureError, write_png};

/// DejaVu Sans, the glyphs that are used; its licence lies beside it.
const FONT: &[u8] = include_bytes!("DejaVuSans-subset.ttf");
const FAMILY: &str = "sans-serif";
/// Width and height, in pixels.
const SIZE: (u32, u32) = (1200, 720);
/// Room on the right for the names of the lines, in pixels.
const NAMES_WIDTH: u32 = 190;
/// Height of a name, in pixels.
const NAME_HEIGHT: i32 = 20;
/// Points between one power of two of `1 / (1 - percentile)` and the next.
const TICKS_PER_HALF_DISTANCE: u32 = 8;
/// Largest percentile file, in bytes: a hundred times what a stage takes.
const HGRM_BYTES_MAX: u64 = 1 << 20;
/// One colour a stage: those that are told apart also by those who see no red or green (after Okabe and Ito), then others.
const COLOURS: [RGBColor; 13] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(120, 120, 120),
    RGBColor(0, 0, 0),
    RGBColor(180, 170, 60),
    RGBColor(106, 61, 154),
    RGBColor(136, 34, 60),
    RGBColor(0, 84, 72),
    RGBColor(150, 110, 70),
];

/// Why latencies could not be written.
#[derive(Debug, thiserror::Error)]
pub enum PlotError {
    /// There is nothing to draw.
    #[error("plot {path}: no latency was recorded")]
    Empty { path: std::path::PathBuf },
    /// It is no percentile file.
    #[error("{path} holds no latencies: {reason}; expected a percentile file, as --hgrm writes it")]
    NoLatencies {
        path: std::path::PathBuf,
        /// What was found.
        reason: String,
    },
    /// Drawing failed.
    #[error("plot: {0}")]
    Draw(String),
    /// The picture could not be written.
    #[error("plot: {0}")]
    Picture(#[from] PictureError),
    /// A file could not be written.
    #[error("latencies: {0}")]
    File(#[from] FileError),
}

/// One line of a plot.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve {
    /// Its name.
    pub label: String,
    /// How many times it is made of.
    pub count: u64,
    /// Quantile, 0 to 1, and the time that this share does not exceed, in us.
    pub points: Vec<(f64, f64)>,
}

impl Curve {
    /// Of times in ns.
    #[must_use]
    pub fn of(label: &str, histogram: &Histogram<u64>) -> Self {
        let points = histogram
            .iter_quantiles(TICKS_PER_HALF_DISTANCE)
            .map(|step| (step.quantile_iterated_to(), step.value_iterated_to() as f64 / 1e3));
        Self { label: label.replace('_', " "), count: histogram.len(), points: points.collect() }
    }

    /// Of a percentile file of HdrHistogram, in us; its name is the curve's.
    pub fn read(path: &Path) -> Result<Self, PlotError> {
        let unreadable = |reason: String| PlotError::NoLatencies { path: path.to_path_buf(), reason };
        let bytes = read_capped(path, HGRM_BYTES_MAX)?;
        let text = String::from_utf8(bytes).map_err(|_| unreadable("it is no text".into()))?;
        let mut curve = Self {
            label: path.file_stem().unwrap_or_default().to_string_lossy().replace('_', " "),
            count: 0,
            points: Vec::new(),
        };
        for line in text.lines().filter(|line| !line.trim().is_empty() && !line.starts_with('#')) {
            let mut numbers = line.split_whitespace().map(str::parse::<f64>);
            match (numbers.next(), numbers.next(), numbers.next()) {
                (Some(Ok(us)), Some(Ok(quantile)), Some(Ok(count)))
                    if us.is_finite() && (0.0..=1.0).contains(&quantile) && count >= 0.0 =>
                {
                    curve.points.push((quantile, us));
                    curve.count = count as u64;
                }
                _ if curve.points.is_empty() && line.contains("Percentile") => {}
                _ => return Err(unreadable(format!("the line {line:?}"))),
            }
        }
        Ok(curve)
    }
}

/// Every curve of the latencies of a run.
#[must_use]
pub fn curves(telemetry: &Telemetry) -> Vec<Curve> {
    let stages = Stage::ALL.into_iter().filter(|stage| !telemetry.histogram(*stage).is_empty());
    stages.map(|stage| Curve::of(stage.as_str(), telemetry.histogram(stage))).collect()
}

/// Writes and draws latencies as asked for; `period_us` is a line in the plot.
pub fn write_latencies(
    files: &LatencyFiles,
    telemetry: &Telemetry,
    title: &str,
    period_us: Option<f64>,
) -> Result<(), PlotError> {
    if let Some(folder) = &files.hgrm {
        telemetry.write_hgrm(folder)?;
    }
    files.plot.as_deref().map_or(Ok(()), |file| plot(file, title, &curves(telemetry), period_us))
}

type Area<'a> = DrawingArea<BitMapBackend<'a>, Shift>;
type Chart<'a, 'b> = ChartContext<'a, BitMapBackend<'b>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;
type Failed = DrawingAreaErrorKind<<BitMapBackend<'static> as DrawingBackend>::ErrorType>;

/// Draws latency by percentile into a PNG file; `period_us` is a dashed line across.
pub fn plot(path: &Path, title: &str, curves: &[Curve], period_us: Option<f64>) -> Result<(), PlotError> {
    static KNOWN: OnceLock<bool> = OnceLock::new();
    if !KNOWN.get_or_init(|| register_font(FAMILY, FontStyle::Normal, FONT).is_ok()) {
        return Err(PlotError::Draw("the built-in font is unreadable; this is a bug of this program".into()));
    }
    let lines: Vec<_> = curves.iter().filter(|curve| curve.count > 0).map(Line::of).collect();
    if lines.is_empty() {
        return Err(PlotError::Empty { path: path.to_path_buf() });
    }
    let mut picture = vec![0; 3 * (SIZE.0 * SIZE.1) as usize];
    {
        let area = BitMapBackend::with_buffer(&mut picture, SIZE).into_drawing_area();
        draw(&area, title, &lines, period_us.map(place_us))
            .and_then(|()| area.present())
            .map_err(|error| PlotError::Draw(error.to_string()))?;
    }
    Ok(write_png(path, [SIZE.0, SIZE.1], &picture)?)
}

/// A curve at its places on the axes.
struct Line {
    label: String,
    points: Vec<(f64, f64)>,
}

impl Line {
    fn of(curve: &Curve) -> Self {
        // The slowest of all stands where one more would have been slower.
        let rightmost = (curve.count as f64).max(2.0).log10();
        let place = |(quantile, us): &(f64, f64)| ((-(1.0 - quantile).log10()).min(rightmost), place_us(*us));
        Self { label: curve.label.clone(), points: curve.points.iter().map(place).collect() }
    }

    fn end(&self) -> f64 {
        self.points.last().map_or(0.0, |(_, y)| *y)
    }
}

fn place_us(time_us: f64) -> f64 {
    time_us.max(1e-3).log10()
}

fn draw(area: &Area<'_>, title: &str, lines: &[Line], period: Option<f64>) -> Result<(), Failed> {
    area.fill(&WHITE)?;
    let points = || lines.iter().flat_map(|line| &line.points);
    let right = points().map(|(x, _)| *x).fold(1.0, f64::max);
    let low = points().map(|(_, y)| *y).chain(period).fold(f64::INFINITY, f64::min) - 0.08;
    let high = points().map(|(_, y)| *y).chain(period).fold(f64::NEG_INFINITY, f64::max) + 0.08;
    let mut chart = ChartBuilder::on(area)
        .margin(14)
        .margin_right(NAMES_WIDTH)
        .caption(title, (FAMILY, 22))
        .x_label_area_size(52)
        .y_label_area_size(78)
        .build_cartesian_2d(0.0..right, low..high)?;
    chart
        .configure_mesh()
        .disable_mesh()
        .x_labels(0)
        .y_labels(0)
        .x_desc("percentile of ticks")
        .y_desc("latency, μs")
        .axis_desc_style((FAMILY, 16))
        .axis_style(BLACK.mix(0.5))
        .draw()?;
    draw_grid(area, &mut chart, right, (low, high))?;
    if let Some(period) = period {
        chart.draw_series(DashedLineSeries::new(
            [(0.0, period), (right, period)],
            8,
            6,
            BLACK.mix(0.6).into(),
        ))?;
        let words = (FAMILY, 14).into_font().color(&BLACK.mix(0.7));
        chart.draw_series([Text::new(
            "control period",
            (0.01 * right, period + 0.02 * (high - low)),
            words,
        )])?;
    }
    for (line, colour) in lines.iter().zip(COLOURS.iter().cycle()) {
        chart.draw_series(LineSeries::new(line.points.iter().copied(), colour.stroke_width(2)))?;
    }
    draw_names(area, &chart, lines, right)
}

fn draw_grid(
    area: &Area<'_>,
    chart: &mut Chart<'_, '_>,
    right: f64,
    (low, high): (f64, f64),
) -> Result<(), Failed> {
    let words = (FAMILY, 14).into_font().color(&BLACK.mix(0.8));
    let halves = [(0.0, "0%".to_owned()), (2_f64.log10(), "50%".to_owned())];
    let decades = (1..=right as i32).map(|decade| (f64::from(decade), percent(decade)));
    for (x, label) in halves.into_iter().chain(decades) {
        chart.draw_series([PathElement::new([(x, low), (x, high)], BLACK.mix(0.12))])?;
        let (left, bottom) = chart.backend_coord(&(x, low));
        let style = words.clone().pos(Pos::new(HPos::Center, VPos::Top));
        area.draw(&Text::new(label, (left, bottom + 6), style))?;
    }
    let fine: &[f64] = if high - low < 3.0 { &[1.0, 2.0, 5.0] } else { &[1.0] };
    for decade in low.floor() as i32..=high.ceil() as i32 {
        for mantissa in fine {
            let value_us = mantissa * 10_f64.powi(decade);
            let y = value_us.log10();
            if y < low || y > high {
                continue;
            }
            let strength = if *mantissa == 1.0 { 0.2 } else { 0.08 };
            chart.draw_series([PathElement::new([(0.0, y), (right, y)], BLACK.mix(strength))])?;
            let (left, middle) = chart.backend_coord(&(0.0, y));
            let style = words.clone().pos(Pos::new(HPos::Right, VPos::Center));
            area.draw(&Text::new(format!("{value_us}"), (left - 8, middle), style))?;
        }
    }
    Ok(())
}

/// `90%`, `99%`, `99.9%` and so on.
fn percent(decade: i32) -> String {
    match decade {
        1 => "90%".to_owned(),
        2 => "99%".to_owned(),
        more => format!("99.{}%", "9".repeat((more - 2) as usize)),
    }
}

/// The names at the ends of their lines, moved apart where they would overlap.
fn draw_names(area: &Area<'_>, chart: &Chart<'_, '_>, lines: &[Line], right: f64) -> Result<(), Failed> {
    let mut order: Vec<usize> = (0..lines.len()).collect();
    order.sort_by(|a, b| lines[*b].end().total_cmp(&lines[*a].end()));
    let wanted: Vec<i32> =
        order.iter().map(|index| chart.backend_coord(&(right, lines[*index].end())).1).collect();
    let left = chart.backend_coord(&(right, 0.0)).0 + 12;
    for (index, top) in order.into_iter().zip(apart(&wanted, SIZE.1 as i32 - 60)) {
        let colour = COLOURS[index % COLOURS.len()];
        let style = (FAMILY, 15).into_font().color(&BLACK.mix(0.85));
        area.draw(&PathElement::new([(left, top), (left + 18, top)], colour.stroke_width(3)))?;
        let style = style.pos(Pos::new(HPos::Left, VPos::Center));
        area.draw(&Text::new(lines[index].label.clone(), (left + 25, top), style))?;
    }
    Ok(())
}

/// Heights of names in falling order, each at least a name's height below the one before, none below `lowest`.
fn apart(wanted: &[i32], lowest: i32) -> Vec<i32> {
    let mut placed: Vec<i32> = Vec::with_capacity(wanted.len());
    for (index, want) in wanted.iter().enumerate() {
        let after_last = placed.last().map_or(i32::MIN, |last| last + NAME_HEIGHT);
        let names_below = (wanted.len() - 1 - index) as i32;
        placed.push((*want).max(after_last).min(lowest - names_below * NAME_HEIGHT));
    }
    placed
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plot_shows_every_curve_and_the_period() {
        let mut histogram = Histogram::new_with_bounds(1, 60_000_000_000, 3).unwrap();
        (1..=5000_u64).for_each(|time| histogram.record(time * 1000).unwrap());
        let mut slower = histogram.clone();
        slower.record_n(9_000_000, 5).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("latency.png");
        let curves = [("fast", &histogram), ("slow", &slower)];
        let curves = curves.map(|(label, histogram)| Curve::of(label, histogram));
        plot(&path, "title", &curves, Some(25_000.0)).unwrap();
        let picture = image::open(&path).unwrap().into_rgb8();
        assert_eq!(picture.dimensions(), SIZE);
        for colour in &COLOURS[..2] {
            let count = picture.pixels().filter(|pixel| pixel.0 == [colour.0, colour.1, colour.2]).count();
            assert!(count > 100, "{count} pixels of a line");
        }
    }

    #[test]
    fn percentile_files_are_read_back_and_others_are_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let mut telemetry = Telemetry::new();
        (1..=5000).for_each(|us| telemetry.record(Stage::EndToEnd, us * 1000));
        let path = telemetry.write_hgrm(folder.path()).unwrap().remove(0);
        let found = Curve::read(&path).unwrap();
        assert_eq!((found.label.as_str(), found.count), ("end to end", 5000));
        let median = found.points.iter().find(|(quantile, _)| *quantile >= 0.5).unwrap().1;
        assert!((median / 2500.0 - 1.0).abs() < 2e-3, "{median}");
        for text in ["", "no numbers here", "1 2 3", "NaN 0.5 3"] {
            std::fs::write(&path, text).unwrap();
            let read = Curve::read(&path);
            assert!(
                text.is_empty() || matches!(read, Err(PlotError::NoLatencies { .. })),
                "{text}: {read:?}"
            );
        }
    }

    #[test]
    fn nothing_recorded_is_an_error_and_no_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("latency.png");
        assert!(matches!(plot(&path, "title", &[], None), Err(PlotError::Empty { .. })));
        assert!(!path.exists());
    }

    #[test]
    fn names_keep_their_order_and_distance_and_stay_on_the_picture() {
        assert_eq!(apart(&[10, 12, 300], 500), [10, 10 + NAME_HEIGHT, 300]);
        let crowded = apart(&[480, 490, 495], 500);
        assert!(crowded.windows(2).all(|pair| pair[1] - pair[0] >= NAME_HEIGHT) && crowded[2] <= 500);
    }

    #[test]
    fn percentiles_have_their_usual_names() {
        assert_eq!([1, 2, 3, 5].map(percent), ["90%", "99%", "99.9%", "99.999%"]);
    }
}
