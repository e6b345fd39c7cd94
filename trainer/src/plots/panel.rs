use image::RgbImage;
use plotters::coord::Shift;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;

use super::axis::{Scale, round_values, tick_label};
use super::text::{FAMILY, load_font};
use super::{Colour, PlotError};

/// A line of a chart.
#[derive(Debug, Clone)]
pub struct Line {
    /// Its name in the legend.
    pub label: String,
    pub colour: Colour,
    /// Points (x, y) in the order of x.
    pub points: Vec<(f64, f64)>,
    /// Shaded around it.
    pub band: Option<Band>,
    /// Pale and thin: what is behind a smoothed line.
    pub faint: bool,
}

/// An area between two values at each x.
#[derive(Debug, Clone)]
pub struct Band {
    /// (x, low, high) in the order of x.
    pub edges: Vec<(f64, f64, f64)>,
}

/// A vertical line with a word beside it.
#[derive(Debug, Clone)]
pub struct Mark {
    /// Where.
    pub x: f64,
    /// What it means.
    pub label: String,
}

/// One chart.
#[derive(Debug, Clone)]
pub struct Panel {
    /// Above it.
    pub title: String,
    /// Below it.
    pub x_label: String,
    /// How values lie along the y axis.
    pub scale: Scale,
    /// What is drawn, the last one on top.
    pub lines: Vec<Line>,
    /// Vertical lines.
    pub marks: Vec<Mark>,
}

type Area<'a> = DrawingArea<BitMapBackend<'a>, Shift>;
type Chart<'a, 'b> = ChartContext<'a, BitMapBackend<'b>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

/// Draws panels in rows of `columns`, each of `size` (width, height) pixels.
///
/// # Errors
/// [`PlotError::Font`] or [`PlotError::Draw`].
pub fn draw(panels: &[Panel], columns: usize, size: (u32, u32)) -> Result<RgbImage, PlotError> {
    load_font()?;
    let columns = columns.clamp(1, panels.len().max(1));
    let rows = panels.len().div_ceil(columns).max(1);
    let (width, height) = (size.0 * columns as u32, size.1 * rows as u32);
    let mut picture = RgbImage::new(width, height);
    {
        let area = BitMapBackend::with_buffer(&mut picture, (width, height)).into_drawing_area();
        let whole = |error: Failed| PlotError::Draw(error.to_string());
        area.fill(&WHITE).map_err(whole)?;
        for (panel, place) in panels.iter().zip(area.split_evenly((rows, columns))) {
            panel.draw(&place).map_err(whole)?;
        }
        area.present().map_err(whole)?;
    }
    Ok(picture)
}

type Failed = DrawingAreaErrorKind<<BitMapBackend<'static> as DrawingBackend>::ErrorType>;

impl Panel {
    fn draw(&self, area: &Area<'_>) -> Result<(), Failed> {
        let caption = (FAMILY, 17).into_font();
        let Some((x_range, y_range)) = self.ranges() else {
            area.titled(&self.title, caption.clone())?;
            let (width, height) = area.dim_in_pixel();
            let middle = (width as i32 / 2 - 25, height as i32 / 2);
            return area.draw(&Text::new("no data", middle, caption.color(&RGBColor(150, 150, 150))));
        };
        let mut chart = ChartBuilder::on(area)
            .margin(8)
            .margin_right(16)
            .caption(&self.title, caption)
            .x_label_area_size(34)
            .y_label_area_size(52)
            .build_cartesian_2d(x_range.0..x_range.1, y_range.0..y_range.1)?;
        self.draw_axes(area, &mut chart, x_range, y_range)?;
        for mark in self.marks.iter().filter(|mark| x_range.0 < mark.x && mark.x < x_range.1) {
            let ends = [(mark.x, y_range.0), (mark.x, y_range.1)];
            chart.draw_series([PathElement::new(ends, BLACK.mix(0.45))])?;
            let words = (FAMILY, 12).into_font().color(&BLACK.mix(0.6));
            let beside = mark.x + 0.01 * (x_range.1 - x_range.0);
            chart.draw_series([Text::new(mark.label.clone(), (beside, y_range.1), words)])?;
        }
        for line in &self.lines {
            self.draw_line(&mut chart, line)?;
        }
        if self.lines.iter().filter(|line| !line.faint).count() > 1 {
            chart
                .configure_series_labels()
                .position(self.free_corner(x_range))
                .background_style(WHITE.mix(0.8))
                .border_style(BLACK.mix(0.15))
                .legend_area_size(18)
                .margin(6)
                .label_font((FAMILY, 13))
                .draw()?;
        }
        Ok(())
    }

    /// Grid, ticks and their labels.
    fn draw_axes(
        &self,
        area: &Area<'_>,
        chart: &mut Chart<'_, '_>,
        x_range: (f64, f64),
        y_range: (f64, f64),
    ) -> Result<(), Failed> {
        chart
            .configure_mesh()
            .disable_mesh()
            .x_labels(0)
            .y_labels(0)
            .x_desc(&self.x_label)
            .axis_desc_style((FAMILY, 13))
            .axis_style(BLACK.mix(0.5))
            .draw()?;
        let grid = BLACK.mix(0.1);
        let words = (FAMILY, 12).into_font().color(&BLACK.mix(0.8));
        use plotters::style::text_anchor::{HPos, Pos, VPos};
        for x in round_values(x_range.0, x_range.1, 5) {
            chart.draw_series([PathElement::new([(x, y_range.0), (x, y_range.1)], grid)])?;
            let at = relative(area, chart.backend_coord(&(x, y_range.0)));
            let style = words.clone().pos(Pos::new(HPos::Center, VPos::Top));
            area.draw(&Text::new(tick_label(x), (at.0, at.1 + 4), style))?;
        }
        for y in self.scale.ticks(y_range.0, y_range.1, 6) {
            chart.draw_series([PathElement::new([(x_range.0, y), (x_range.1, y)], grid)])?;
            let at = relative(area, chart.backend_coord(&(x_range.0, y)));
            let style = words.clone().pos(Pos::new(HPos::Right, VPos::Center));
            area.draw(&Text::new(tick_label(self.scale.value(y)), (at.0 - 5, at.1), style))?;
        }
        Ok(())
    }

    fn draw_line(&self, chart: &mut Chart<'_, '_>, line: &Line) -> Result<(), Failed> {
        let [r, g, b] = line.colour;
        let colour = RGBColor(r, g, b);
        if let Some(band) = &line.band {
            // What lies below a logarithm's axis is cut off at the line's own lowest point.
            let floor = self.places(line).map(|(_, y)| y).fold(f64::INFINITY, f64::min);
            let low = |y: f64| self.scale.place(y).unwrap_or(floor);
            let upper = band.edges.iter().filter_map(|(x, _, high)| Some((*x, self.scale.place(*high)?)));
            let lower = band.edges.iter().rev().map(|(x, bottom, _)| (*x, low(*bottom)));
            let outline: Vec<_> = upper.chain(lower).collect();
            chart.draw_series([Polygon::new(outline, colour.mix(0.15))])?;
        }
        let style = if line.faint { colour.mix(0.25).stroke_width(1) } else { colour.stroke_width(2) };
        let points: Vec<_> = self.places(line).collect();
        let dots: Vec<_> = if points.len() < 40 && !line.faint && line.band.is_none() {
            points.iter().map(|point| Circle::new(*point, 3, colour.filled())).collect()
        } else {
            Vec::new()
        };
        let drawn = chart.draw_series(LineSeries::new(points, style))?;
        if !line.faint {
            drawn
                .label(&line.label)
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 14, y)], colour.stroke_width(3)));
        }
        chart.draw_series(dots)?;
        Ok(())
    }

    /// The upper corner that the lines are further away from.
    fn free_corner(&self, (left, right): (f64, f64)) -> SeriesLabelPosition {
        let middle = (left + right) / 2.0;
        let highest = |on_left: bool| {
            let here = self
                .lines
                .iter()
                .flat_map(|line| self.places(line))
                .filter(|(x, _)| (*x < middle) == on_left);
            here.map(|(_, y)| y).fold(f64::NEG_INFINITY, f64::max)
        };
        if highest(true) < highest(false) {
            SeriesLabelPosition::UpperLeft
        } else {
            SeriesLabelPosition::UpperRight
        }
    }

    /// The points that have a place on the axes.
    fn places<'a>(&'a self, line: &'a Line) -> impl Iterator<Item = (f64, f64)> + 'a {
        line.points.iter().filter_map(|(x, y)| Some((*x, self.scale.place(*y)?)))
    }

    /// Ends of both axes; none where there is nothing to see.
    fn ranges(&self) -> Option<((f64, f64), (f64, f64))> {
        let mut x = (f64::INFINITY, f64::NEG_INFINITY);
        let mut y = x;
        let widen = |ends: &mut (f64, f64), value: f64| *ends = (ends.0.min(value), ends.1.max(value));
        for line in &self.lines {
            for (at, value) in self.places(line) {
                widen(&mut x, at);
                widen(&mut y, value);
            }
            for (_, low, high) in line.band.iter().flat_map(|band| &band.edges) {
                [low, high]
                    .into_iter()
                    .filter_map(|edge| self.scale.place(*edge))
                    .for_each(|edge| widen(&mut y, edge));
            }
        }
        if x.0 > x.1 {
            return None;
        }
        let roomy = |(low, high): (f64, f64), share: f64| {
            let room = if high > low { (high - low) * share } else { low.abs().max(1.0) * 0.05 };
            (low - room, high + room)
        };
        Some((roomy(x, 0.0), roomy(y, 0.06)))
    }
}

/// A place on the whole picture as one within an area.
fn relative(area: &Area<'_>, at: (i32, i32)) -> (i32, i32) {
    let (left, top) = area.get_base_pixel();
    (at.0 - left, at.1 - top)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn panel(points: Vec<(f64, f64)>) -> Panel {
        let colour = super::super::COLOURS[0];
        let line = Line { label: "a".into(), colour, points, band: None, faint: false };
        Panel {
            title: "title".into(),
            x_label: "x".into(),
            scale: Scale::Log,
            lines: vec![line],
            marks: Vec::new(),
        }
    }

    #[test]
    fn panels_stand_in_rows_and_show_their_lines() {
        let panels = [panel(vec![(0.0, 1.0), (1.0, 10.0)]), panel(vec![]), panel(vec![(0.0, 5.0)])];
        let picture = draw(&panels, 2, (240, 160)).unwrap();
        assert_eq!(picture.dimensions(), (480, 320));
        let blue = |left: u32, top: u32| {
            let inside = |(x, y): (u32, u32)| picture.get_pixel(left + x, top + y).0 == [0, 114, 178];
            (0..240 * 160).filter(|index| inside((index % 240, index / 240))).count()
        };
        assert!(blue(0, 0) > 50 && blue(0, 160) > 5);
        assert_eq!(blue(240, 0), 0, "a panel without data shows no line");
    }

    #[test]
    fn values_without_a_logarithm_are_left_out() {
        let panel = panel(vec![(0.0, 0.0), (1.0, 10.0), (2.0, f64::NAN)]);
        assert_eq!(panel.places(&panel.lines[0]).collect::<Vec<_>>(), [(1.0, 1.0)]);
    }
}
