//! What is drawn where.

use rcwm_models::wire::Observation;

use super::canvas::{Area, Canvas, Colour, Style};
use super::meter::{Meter, Snapshot};
use super::picture::{self, Colours};

/// Everything that is drawn.
pub struct Shown<'a> {
    pub snapshot: &'a Snapshot,
    pub meter: &'a Meter,
    /// Whose picture is shown.
    pub observation: Option<Observation<'a>>,
    /// Which camera's.
    pub camera: usize,
    pub colours: Colours,
    pub paused: bool,
    /// What is wrong with the link.
    pub trouble: Option<&'a str>,
}

/// Columns that a name and a number take beside a bar.
const NAME_COLUMNS: usize = 12;
const NUMBER_COLUMNS: usize = 9;
/// Rows of the latencies, their frame included.
const LATENCY_ROWS: usize = 6;
/// Of the terminal's own colours.
const RED: u8 = 1;
const GREEN: u8 = 2;
const YELLOW: u8 = 3;
const CYAN: u8 = 6;

/// Draws all of it, as far as it fits.
pub fn draw(to: &mut Canvas, shown: &Shown<'_>) {
    let (first, rest) = to.area().split_rows(1);
    let (second, rest) = rest.split_rows(1);
    let (body, foot) = rest.split_rows(rest.rows.saturating_sub(1));
    draw_first_line(to, first, shown);
    to.text(second, &second_line(shown.snapshot), Style::default());
    let paused = if shown.paused { "   paused: what is drawn is old" } else { "" };
    to.text(foot, &format!(" q quits   p pauses   c shows the next camera{paused}"), Style::default());
    let right = match &shown.observation {
        Some(observation) if !observation.format().interface().camera.is_empty() => {
            let (left, right) = body.split_columns(body.columns / 2);
            draw_picture(to, left, shown, observation);
            right
        }
        _ => body,
    };
    let (latency, rest) = right.split_rows(LATENCY_ROWS);
    draw_latency(to, latency, shown);
    let sent = actions(shown.meter);
    let (action, measured) = rest.split_rows(sent.len() + 2);
    let title = if shown.snapshot.mode.is_some() { "action sent" } else { "action executed" };
    draw_bars(to, action, shown, title, &sent);
    draw_bars(to, measured, shown, "state, between lowest and highest so far", &states(shown.meter));
}

impl Shown<'_> {
    fn style(&self, colour: u8) -> Style {
        Style::of((self.colours != Colours::None).then_some(Colour::Indexed(colour)))
    }
}

fn draw_first_line(to: &mut Canvas, line: Area, shown: &Shown<'_>) {
    let Snapshot { instance, robot, rate_hz, period_us, mode, flags, .. } = shown.snapshot;
    let (plain, bold) = (Style::default(), Style { bold: true, ..Style::default() });
    let line = to.text(line, &format!(" {instance}"), bold);
    let Some(robot) = robot else {
        to.text(line, &format!("  {}", shown.trouble.unwrap_or("waiting for a robot")), plain);
        return;
    };
    let line = to.text(line, &format!("  {robot}  "), plain);
    let colour = match *mode {
        Some("tracking") => GREEN,
        Some("imagining") => YELLOW,
        _ => RED,
    };
    let style = Style { bold: true, ..shown.style(colour) };
    let line = to.text(line, mode.unwrap_or("no controller answers"), style);
    let rate = rate_hz.map_or_else(|| "-".to_owned(), |rate_hz| format!("{rate_hz:.1}"));
    let pace = match period_us {
        Some(period_us) => format!("  {rate} Hz of {:.1}", 1e6 / period_us),
        None => format!("  {rate} Hz, lock-step"),
    };
    let flags = if flags.is_empty() { String::new() } else { format!("  [{}]", flags.join(" ")) };
    to.text(line, &(pace + &flags), plain);
}

fn second_line(snapshot: &Snapshot) -> String {
    let Snapshot { counts, episode, step, reward, .. } = snapshot;
    let mut text = format!(
        " deadlines missed {} of {}  imagined {}  fallback {}  of {} answers",
        counts.deadlines_missed, counts.observations, counts.imagined, counts.fallback, counts.answers
    );
    if let (Some(episode), Some(step)) = (episode, step) {
        text += &format!("  episode {episode} step {step}");
    }
    if let Some(reward) = reward {
        text += &format!(" reward {reward:.3}");
    }
    text
}

fn draw_picture(to: &mut Canvas, area: Area, shown: &Shown<'_>, observation: &Observation<'_>) {
    let cameras = &observation.format().interface().camera;
    let at = shown.camera % cameras.len();
    let [rows, columns, _] = cameras[at].shape;
    let age = match observation.captured_ns[at] {
        0 => String::new(),
        taken_ns => {
            let age_ms = observation.published_ns.saturating_sub(taken_ns) as f64 / 1e6;
            format!(", {age_ms:.1} ms old when published")
        }
    };
    let name = &cameras[at].name;
    let title = format!(" {name} {columns} x {rows}, camera {} of {}{age} ", at + 1, cameras.len());
    let inside = to.frame(area, &title);
    picture::draw(to, inside, observation.image(at), [rows, columns], shown.colours);
}

fn draw_latency(to: &mut Canvas, area: Area, shown: &Shown<'_>) {
    let title = match &shown.snapshot.latency_us {
        Some(us) => {
            format!(
                " observation to action: p50 {:.0} us, p99 {:.0} us, max {:.0} us ",
                us.p50, us.p99, us.max
            )
        }
        None => " observation to action ".to_owned(),
    };
    let inside = to.frame(area, &title);
    let newest: Vec<_> = shown.meter.latencies_us().rev().take(inside.columns).collect();
    let highest = newest.iter().copied().fold(1.0, f64::max);
    for (at, us) in newest.iter().enumerate() {
        let column = inside.column + inside.columns - 1 - at;
        let eighths = (us / highest * (inside.rows * 8) as f64).round() as usize;
        for row in 0..inside.rows {
            let letter = UPWARDS[eighths.saturating_sub(row * 8).min(8)];
            to.put(column, inside.row + inside.rows - 1 - row, letter, shown.style(CYAN));
        }
    }
}

/// Cells that are filled by so many eighths.
const UPWARDS: [char; 9] = [' ', '▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];
const RIGHTWARDS: [char; 9] = ['·', '▏', '▎', '▍', '▌', '▋', '▊', '▉', '█'];

/// A number between two others.
struct Bar<'a> {
    name: &'a str,
    value: f32,
    low: f32,
    high: f32,
}

fn actions(meter: &Meter) -> Vec<Bar<'_>> {
    let Some(format) = meter.format() else { return Vec::new() };
    let values = meter.sent().map_or(meter.executed(), |action| &action.action);
    let actions = format.interface().action.iter();
    let numbers = actions.flat_map(|action| action.elements.iter().zip(action.low.iter().zip(&action.high)));
    let bars = numbers.zip(values);
    bars.map(|((name, (low, high)), value)| Bar { name, value: *value, low: *low as f32, high: *high as f32 })
        .collect()
}

fn states(meter: &Meter) -> Vec<Bar<'_>> {
    let Some(format) = meter.format() else { return Vec::new() };
    let names = format.interface().state.iter().flat_map(|state| &state.elements);
    let bars = names.zip(meter.state());
    bars.map(|(name, (value, (low, high)))| Bar { name, value, low, high }).collect()
}

fn draw_bars(to: &mut Canvas, area: Area, shown: &Shown<'_>, title: &str, bars: &[Bar<'_>]) {
    let left_out = bars.len().saturating_sub(area.rows.saturating_sub(2));
    let more = if left_out > 0 { format!("({left_out} more) ") } else { String::new() };
    let mut rest = to.frame(area, &format!(" {title} {more}"));
    for bar in bars.iter().take(rest.rows) {
        let line;
        (line, rest) = rest.split_rows(1);
        let name: String = bar.name.chars().take(NAME_COLUMNS).collect();
        let line = to.text(line, &format!("{name:>NAME_COLUMNS$} "), Style::default());
        let columns = line.columns.saturating_sub(NUMBER_COLUMNS + 1);
        let line = to.text(line, &filled(bar, columns), shown.style(CYAN));
        to.text(line, &format!(" {:>NUMBER_COLUMNS$.3}", bar.value), Style::default());
    }
}

/// A row of so many columns, filled as far as the number is on its way from its lowest to its highest.
fn filled(bar: &Bar<'_>, columns: usize) -> String {
    let range = f64::from(bar.high) - f64::from(bar.low);
    let share = (f64::from(bar.value) - f64::from(bar.low)) / range;
    // Of what never moved, or is no number, nothing is filled.
    let share = if share.is_finite() { share.clamp(0.0, 1.0) } else { 0.0 };
    let eighths = (share * (columns * 8) as f64).round() as usize;
    (0..columns).map(|column| RIGHTWARDS[eighths.saturating_sub(column * 8).min(8)]).collect()
}

#[cfg(test)]
mod tests {
    use rcwm_models::wire::{Action, ActionSource, Format, ObservationFlags, OwnedObservation};

    use super::*;

    fn observation(sequence: u64) -> OwnedObservation {
        let mut observation = OwnedObservation::zeroed(&Format::metaworld());
        (observation.sequence, observation.step) = (sequence, sequence as u32);
        observation.published_ns = 1_000_000_000 + sequence * 25_000_000;
        (observation.scheduled_ns, observation.period_ns) = (observation.published_ns, 25_000_000);
        observation.flags = ObservationFlags::default().with(ObservationFlags::ACTION_HELD, sequence == 5).0;
        observation.edit().state()[0] = sequence as f32;
        observation.edit().image(0).fill(200);
        observation
    }

    /// Ten observations, of which the fourth was not seen and the sixth had no answer in time; answered after 2 ms each.
    fn met() -> Meter {
        let mut meter = Meter::default();
        meter.robot_came(&Format::metaworld());
        for sequence in (0..10).filter(|sequence| *sequence != 3) {
            let observation = observation(sequence);
            meter.observed(&observation.view());
            let published_ns = observation.published_ns + 2_000_000;
            let source = if sequence == 9 { ActionSource::Imagined } else { ActionSource::Policy } as u32;
            meter.answered(Action {
                answers: sequence,
                published_ns,
                source,
                action: [0.5, -1.0, 1.0, 0.0].into(),
            });
        }
        meter
    }

    fn drawn(meter: &Meter, columns: usize, rows: usize) -> Vec<String> {
        let (snapshot, last) = (meter.snapshot("arm"), observation(9));
        let observation = meter.format().map(|_| last.view());
        let shown = Shown {
            snapshot: &snapshot,
            meter,
            observation,
            camera: 0,
            colours: Colours::None,
            paused: false,
            trouble: None,
        };
        let mut canvas = Canvas::new(columns, rows);
        draw(&mut canvas, &shown);
        (0..rows).map(|row| canvas.row(row)).collect()
    }

    #[test]
    fn what_is_seen_is_counted_and_timed() {
        let snapshot = met().snapshot("arm");
        let counts = snapshot.counts;
        assert_eq!((counts.observations, counts.unseen, counts.deadlines_missed), (9, 1, 1));
        assert_eq!((counts.answers, counts.imagined, counts.fallback), (9, 1, 0));
        assert_eq!((snapshot.rate_hz, snapshot.mode), (Some(40.0), Some("imagining")));
        let latency = snapshot.latency_us.unwrap();
        assert_eq!((latency.p50, latency.p99), (2000.0, 2000.0));
    }

    #[test]
    fn a_screen_tells_rate_deadlines_latency_and_numbers() {
        let screen = drawn(&met(), 100, 30);
        assert!(screen[0].contains("arm  metaworld  imagining  40.0 Hz of 40.0"), "{}", screen[0]);
        assert!(screen[1].contains("deadlines missed 1 of 9  imagined 1"), "{}", screen[1]);
        assert!(screen[2].contains("image 64 x 64, camera 1 of 1") && screen[2].contains("p50 2000 us"));
        let row = |name: &str| screen.iter().find(|row| row.contains(name)).unwrap();
        assert!(row("gripper").contains("0.000") && row("           x ").contains("0.500"), "{screen:#?}");
        assert!(row("right_j0").contains("█") && row("right_j0").contains("9.000"), "{screen:#?}");
    }

    #[test]
    fn every_size_is_drawn() {
        let (met, waiting) = (met(), Meter::default());
        for columns in [1, 2, 3, 20, 21, 80, 300] {
            for rows in [1, 2, 3, 4, 9, 24, 100] {
                drawn(&met, columns, rows);
                let screen = drawn(&waiting, columns, rows);
                assert!(columns < 80 || screen[0].contains("waiting for a robot"));
            }
        }
    }

    #[test]
    fn bars_are_filled_from_limit_to_limit() {
        let of = |value| filled(&Bar { name: "", value, low: -1.0, high: 1.0 }, 4);
        assert_eq!(
            [of(-1.0), of(0.0), of(1.0), of(5.0), of(f32::NAN)],
            ["····", "██··", "████", "████", "····"]
        );
        assert_eq!(of(-0.75), "▌···");
    }
}
