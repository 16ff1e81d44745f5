//! Bodies in the plane: their shapes, their paths, and where they begin and end.

use crate::Color;
use crate::canvas::{Anchor, Canvas, Font, MARGIN, Paint, Point, WIDTH, sane};
use crate::scale::{Scale, number, round_step, span};
use crate::text::{fit, width};

/// Maximum number of bodies.
const MAX_BODIES: usize = 32;
/// Maximum number of points of a drawn path.
const MAX_POINTS: usize = 600;
/// Minimum and maximum height of the area.
const HEIGHT: (f64, f64) = (160.0, 620.0);
/// Largest magnitude of a coordinate or size, in meters.
const FAR: f64 = 1e6;
const LABEL: f64 = 14.0;
const SMALL: f64 = 13.0;

/// A plan in meters, with the same scale in both directions. `x` is to the right, `y` is up.
///
/// A body that moves has a dashed shape where it begins, a path, and a filled shape where it ends. A line in the
/// shape has the direction of its heading.
///
/// ```
/// use fipa_drawing::{Body, Color, Plane, Pose, Shape};
///
/// let rover = Body {
///     name: "rover".to_owned(),
///     shape: Shape::Circle { radius: 0.25 },
///     color: Color::nth(0),
///     poses: vec![
///         Pose { x: 0.0, y: 0.0, heading: 0.0 },
///         Pose { x: 2.0, y: 1.0, heading: 0.5 },
///     ],
/// };
/// assert!(Plane { bodies: vec![rover] }.svg().contains(">rover<"));
/// ```
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Plane {
    /// Bodies, at most 32. Their names are beside their last poses.
    pub bodies: Vec<Body>,
}

/// A body.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Body {
    /// Name. May be empty.
    pub name: String,
    /// Outline.
    pub shape: Shape,
    /// Color of the outline and of the path.
    pub color: Color,
    /// Poses in the order of time: a single one of a body that does not move. Those that are not finite are ignored.
    pub poses: Vec<Pose>,
}

/// Outline of a body around its pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Shape {
    /// A circle.
    Circle {
        /// Radius in meters.
        radius: f64,
    },
    /// A rectangle. The pose is its center.
    Rectangle {
        /// Extent along the heading, in meters.
        length: f64,
        /// Extent across the heading, in meters.
        width: f64,
    },
}

/// Position and direction.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Pose {
    /// To the right, in meters.
    pub x: f64,
    /// Up, in meters.
    pub y: f64,
    /// Direction in radians, counterclockwise from the direction of `x`.
    pub heading: f64,
}

impl Default for Shape {
    fn default() -> Self {
        Self::Circle { radius: 0.1 }
    }
}

impl Shape {
    /// Returns the radius of the circle around the shape.
    fn reach(self) -> f64 {
        match self {
            Self::Circle { radius } => limited(radius),
            Self::Rectangle { length, width } => limited(length).hypot(limited(width)) / 2.0,
        }
    }

    /// Returns the radius of the circle that touches the front.
    fn front(self) -> f64 {
        match self {
            Self::Circle { radius } => limited(radius),
            Self::Rectangle { length, .. } => limited(length) / 2.0,
        }
    }
}

/// Limits the size of a shape.
fn limited(size: f64) -> f64 {
    sane(size).clamp(0.0, FAR)
}

/// A body that can be drawn.
struct Placed<'a> {
    body: &'a Body,
    poses: Vec<Pose>,
    first: Pose,
    last: Pose,
}

impl<'a> Placed<'a> {
    fn of(body: &'a Body) -> Option<Self> {
        let finite = |pose: &&Pose| {
            [pose.x, pose.y, pose.heading]
                .iter()
                .all(|it| it.is_finite())
        };
        let limited = |pose: &Pose| Pose {
            x: pose.x.clamp(-FAR, FAR),
            y: pose.y.clamp(-FAR, FAR),
            heading: pose.heading,
        };
        let poses: Vec<Pose> = body.poses.iter().filter(finite).map(limited).collect();
        let (first, last) = (*poses.first()?, *poses.last()?);
        Some(Self {
            body,
            poses,
            first,
            last,
        })
    }

    fn moves(&self) -> bool {
        self.poses
            .iter()
            .any(|pose| (pose.x, pose.y) != (self.first.x, self.first.y))
    }
}

/// Maps meters to the drawing.
struct View {
    x: Scale,
    y: Scale,
    /// Length of a meter.
    meter: f64,
    /// Upper left and lower right corner of the area.
    corners: (Point, Point),
}

impl View {
    fn of(bodies: &[Placed<'_>], wide: f64) -> Self {
        let ends = |of: fn(&Pose) -> f64| {
            let around = bodies.iter().flat_map(move |placed| {
                let reach = placed.body.shape.reach();
                placed
                    .poses
                    .iter()
                    .flat_map(move |pose| [of(pose) - reach, of(pose) + reach])
            });
            let (from, until) = span(around).unwrap_or((0.0, 1.0));
            let space = ((until - from) * 0.04).max(0.05);
            (from - space, until + space)
        };
        let ((left, right), (low, high)) = (ends(|pose| pose.x), ends(|pose| pose.y));
        let (edge, wide) = (MARGIN + 50.0, wide - 2.0 * MARGIN - 50.0);
        let meter = (wide / (right - left)).min(HEIGHT.1 / (high - low));
        let tall = ((high - low) * meter).max(HEIGHT.0);
        let (aside, above) = (wide / meter / 2.0, tall / meter / 2.0);
        let (x, y) = (f64::midpoint(left, right), f64::midpoint(low, high));
        Self {
            x: Scale::linear((x - aside, x + aside), (edge, edge + wide)),
            y: Scale::linear((y - above, y + above), (8.0 + tall, 8.0)),
            meter,
            corners: ((edge, 8.0), (edge + wide, 8.0 + tall)),
        }
    }

    fn place(&self, pose: Pose) -> Point {
        (self.x.place(pose.x), self.y.place(pose.y))
    }

    fn axes(&self, out: &mut Canvas) {
        let ((left, top), (right, bottom)) = self.corners;
        let step = round_step(80.0 / self.meter);
        let faint = Paint::edge(Color::FAINT, 1.0);
        let marks = self
            .x
            .marks_by(step)
            .into_iter()
            .map(|value| (self.x.place(value), value));
        let marks: Vec<(f64, f64)> = marks.collect();
        for (x, _) in &marks {
            out.line((*x, top), (*x, bottom), faint);
        }
        let labels = marks
            .iter()
            .map(|(x, value)| (*x, format!("{} m", number(*value))));
        out.labels(bottom + 18.0, SMALL, labels);
        for value in self.y.marks_by(step) {
            let y = self.y.place(value);
            out.line((left, y), (right, y), faint);
            let font = Font::new(SMALL).anchor(Anchor::End);
            let text = format!("{} m", number(value));
            out.text_within((left - 6.0, y + 5.0), font, &text, left - 8.0);
        }
        out.rect(
            (left, top),
            (right - left, bottom - top),
            0.0,
            Paint::edge(Color::GRAY, 1.0),
        );
    }

    fn shape(&self, out: &mut Canvas, shape: Shape, pose: Pose, paint: Paint) {
        let (x, y) = self.place(pose);
        let (sin, cos) = pose.heading.sin_cos();
        match shape {
            Shape::Circle { radius } => {
                out.circle((x, y), (limited(radius) * self.meter).max(2.0), paint);
            }
            Shape::Rectangle { length, width } => {
                let along = (limited(length) * self.meter / 2.0).max(2.0);
                let aside = (limited(width) * self.meter / 2.0).max(2.0);
                let corners = [(1.0, 1.0), (1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0)];
                let corners = corners.map(|(front, left)| {
                    let (ahead, left) = (front * along, left * aside);
                    (x + ahead * cos - left * sin, y - ahead * sin - left * cos)
                });
                out.path(&corners, true, paint);
            }
        }
    }

    /// Draws the line from the middle of a shape to its front.
    fn heading(&self, out: &mut Canvas, shape: Shape, pose: Pose, paint: Paint) {
        let (x, y) = self.place(pose);
        let (sin, cos) = pose.heading.sin_cos();
        let length = (shape.front() * self.meter).max(8.0);
        out.line((x, y), (x + length * cos, y - length * sin), paint);
    }

    /// Draws the path through poses. Points that are near the one before are left out.
    fn path(&self, out: &mut Canvas, poses: &[Pose], color: Color) {
        let mut points: Vec<Point> = Vec::new();
        for pose in poses {
            let (x, y) = self.place(*pose);
            let far = |last: &Point| (last.0 - x).hypot(last.1 - y) >= 1.5;
            if points.last().is_none_or(far) {
                points.push((x, y));
            }
        }
        let stride = points.len().div_ceil(MAX_POINTS).max(1);
        let last = poses.last().map(|pose| self.place(*pose));
        let mut thinned: Vec<Point> = points.into_iter().step_by(stride).collect();
        thinned.extend(last);
        out.path(&thinned, false, Paint::edge(color, 2.2));
    }
}

/// A rectangle that a label must not cover.
#[derive(Debug, Clone, Copy)]
struct Taken {
    from: Point,
    until: Point,
}

impl Taken {
    fn meets(&self, other: &Self) -> bool {
        self.from.0 < other.until.0
            && other.from.0 < self.until.0
            && self.from.1 < other.until.1
            && other.from.1 < self.until.1
    }
}

impl Plane {
    /// Draws the plan as an SVG document.
    #[must_use]
    pub fn svg(&self) -> String {
        self.canvas(WIDTH).finish("Plan")
    }

    pub(crate) fn canvas(&self, wide: f64) -> Canvas {
        let bodies = self.bodies.iter().take(MAX_BODIES).filter_map(Placed::of);
        let mut bodies: Vec<Placed<'_>> = bodies.collect();
        // Large bodies are below small ones.
        bodies.sort_by(|a, b| b.body.shape.reach().total_cmp(&a.body.shape.reach()));
        let view = View::of(&bodies, wide);
        let mut out = Canvas::new(wide);
        view.axes(&mut out);
        let (moving, fixed): (Vec<&Placed<'_>>, Vec<&Placed<'_>>) =
            bodies.iter().partition(|placed| placed.moves());
        for placed in &fixed {
            draw_end(&view, placed, &mut out);
        }
        for placed in &moving {
            view.path(&mut out, &placed.poses, placed.body.color);
        }
        for placed in &moving {
            let paint = Paint::edge(placed.body.color, 1.6).dashed(true);
            view.shape(&mut out, placed.body.shape, placed.first, paint);
            let dot = Paint::edge(placed.body.color, 2.0).with(Color::WHITE);
            out.circle(view.place(placed.first), 4.0, dot);
        }
        for placed in &moving {
            draw_end(&view, placed, &mut out);
        }
        names(&view, &bodies, &mut out);
        let y = view.corners.1.1 + 42.0;
        legend(y, !moving.is_empty(), &mut out);
        out.height = y + 14.0;
        out
    }
}

fn draw_end(view: &View, placed: &Placed<'_>, out: &mut Canvas) {
    let (shape, color) = (placed.body.shape, placed.body.color);
    let paint = Paint::edge(color, 2.0).with(color.light());
    out.tip(&placed.body.name, |out| {
        view.shape(out, shape, placed.last, paint);
        if placed.moves() {
            view.heading(out, shape, placed.last, Paint::edge(Color::INK, 2.2));
        }
    });
}

/// Writes the names beside the bodies, where there is room.
fn names(view: &View, bodies: &[Placed<'_>], out: &mut Canvas) {
    let around = |pose: Pose, reach: f64| {
        let (x, y) = view.place(pose);
        Taken {
            from: (x - reach, y - reach),
            until: (x + reach, y + reach),
        }
    };
    let mut taken: Vec<Taken> = Vec::new();
    // Paths and large bodies are covered only by a name without another place.
    let mut avoided: Vec<Taken> = Vec::new();
    for placed in bodies {
        let reach = placed.body.shape.reach() * view.meter;
        let list = if reach < 60.0 {
            &mut taken
        } else {
            &mut avoided
        };
        list.push(around(placed.last, reach * 0.8));
        if placed.moves() {
            taken.push(around(placed.first, 6.0));
            let stride = placed.poses.len().div_ceil(MAX_POINTS).max(1);
            let path = placed.poses.iter().step_by(stride);
            avoided.extend(path.map(|pose| around(*pose, 2.0)));
        }
    }
    let ((left, top), (right, bottom)) = view.corners;
    for placed in bodies {
        let name = fit(&placed.body.name, LABEL, true, 200.0);
        if name.is_empty() {
            continue;
        }
        let (half, (x, y)) = (
            width(&name, LABEL, true) / 2.0 + 2.0,
            view.place(placed.last),
        );
        let reach = (placed.body.shape.reach() * view.meter).max(6.0);
        let at = (0..8).flat_map(|ring| {
            let far = reach + 4.0 + f64::from(ring) * 18.0;
            let sides = [(0.0, -1.0), (0.0, 1.0), (1.0, 0.0), (-1.0, 0.0)];
            let corners = [(0.8, -0.8), (-0.8, -0.8), (0.8, 0.8), (-0.8, 0.8)];
            let both = sides.into_iter().chain(corners);
            both.map(move |(aside, down)| (x + aside * (far + half), y + down * (far + 10.0)))
        });
        // A large body has room for its name.
        let inside = (reach > half + 10.0).then_some((x, y));
        let free = |(x, y): Point, avoided: &[Taken]| {
            let label = Taken {
                from: (x - half, y - 10.0),
                until: (x + half, y + 10.0),
            };
            let is_inside = label.from.0 > left + 2.0
                && label.until.0 < right - 2.0
                && label.from.1 > top + 2.0
                && label.until.1 < bottom - 2.0;
            let mut others = taken.iter().chain(avoided);
            (is_inside && !others.any(|other| other.meets(&label))).then_some(((x, y), label))
        };
        let own = inside.and_then(|at| free(at, &[]));
        let cover = if own.is_some() {
            placed.body.color.light()
        } else {
            Color::WHITE
        };
        let free = own
            .or_else(|| at.clone().find_map(|at| free(at, &avoided)))
            .or_else(|| at.clone().find_map(|at| free(at, &[])));
        // A name without room is shown under the pointer.
        let Some(((name_x, name_y), label)) = free else {
            continue;
        };
        taken.push(label);
        if own.is_none() {
            // From the inside of the body, because bodies can touch.
            let begin = ((x + x + name_x) / 3.0, (y + y + name_y) / 3.0);
            let begin = if reach < 12.0 { (x, y) } else { begin };
            out.line(begin, (name_x, name_y), Paint::edge(Color::INK, 1.0));
        }
        let font = Font::new(LABEL).bold().anchor(Anchor::Middle).cover(cover);
        out.text((name_x, name_y + 5.0), font, &name);
    }
}

fn legend(y: f64, moving: bool, out: &mut Canvas) {
    if !moving {
        return;
    }
    let mut x = MARGIN + 50.0;
    let gray = Color::GRAY;
    out.circle((x + 9.0, y), 8.0, Paint::edge(gray, 1.6).dashed(true));
    out.circle((x + 9.0, y), 3.5, Paint::edge(gray, 2.0).with(Color::WHITE));
    out.text((x + 24.0, y + 5.0), Font::new(SMALL), "start");
    x += 90.0;
    out.line((x, y), (x + 28.0, y), Paint::edge(gray, 2.2));
    out.text((x + 36.0, y + 5.0), Font::new(SMALL), "path");
    x += 100.0;
    out.circle((x + 9.0, y), 8.0, Paint::edge(gray, 2.0).with(gray.light()));
    out.line((x + 9.0, y), (x + 17.0, y), Paint::edge(Color::INK, 2.2));
    out.text((x + 24.0, y + 5.0), Font::new(SMALL), "end, with heading");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_directions_have_one_scale() {
        for (x, y) in [(10.0, 0.5), (0.5, 10.0), (3.0, 3.0)] {
            let pose = |x, y| Pose { x, y, heading: 0.0 };
            let body = Body {
                poses: vec![pose(0.0, 0.0), pose(x, y)],
                ..Body::default()
            };
            let placed: Vec<Placed<'_>> = Placed::of(&body).into_iter().collect();
            let view = View::of(&placed, WIDTH);
            let (begin, end) = (view.place(pose(0.0, 0.0)), view.place(pose(x, y)));
            assert!(((end.0 - begin.0) / x - view.meter).abs() < 1e-6);
            // Up in the plane is towards smaller positions in the drawing.
            assert!(((begin.1 - end.1) / y - view.meter).abs() < 1e-6);
        }
    }

    #[test]
    fn start_and_end_are_marked() {
        let pose = |x| Pose {
            x,
            ..Pose::default()
        };
        let moving = Body {
            name: "rover".to_owned(),
            poses: vec![pose(0.0), pose(1.0), pose(f64::NAN)],
            ..Body::default()
        };
        let fixed = Body {
            poses: vec![pose(3.0)],
            ..Body::default()
        };
        let svg = |body: &Body| {
            Plane {
                bodies: vec![body.clone()],
            }
            .svg()
        };
        assert!(svg(&moving).contains("stroke-dasharray") && svg(&moving).contains(">start<"));
        assert!(!svg(&fixed).contains("stroke-dasharray"));
    }
}
