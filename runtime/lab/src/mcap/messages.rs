//! The ROS 2 messages that are written: their definitions with those that they refer to, and their encoding.

use super::cdr::Cdr;

/// A message type.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Schema {
    Image,
    JointState,
    Numbers,
    Text,
    Event,
}

const TIME: &str = "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n";
const HEADER: &str = "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n";
const DIMENSION: &str = "MSG: std_msgs/MultiArrayDimension\nstring label\nuint32 size\nuint32 stride\n";
const LAYOUT: &str =
    "MSG: std_msgs/MultiArrayLayout\nstd_msgs/MultiArrayDimension[] dim\nuint32 data_offset\n";
const IMAGE: &str = "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n";
const JOINT_STATE: &str =
    "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n";
const NUMBERS: &str = "std_msgs/MultiArrayLayout layout\nfloat64[] data\n";
const LOG: &str = "byte DEBUG=10\nbyte INFO=20\nbyte WARN=30\nbyte ERROR=40\nbyte FATAL=50\nbuiltin_interfaces/Time stamp\n\
    uint8 level\nstring name\nstring msg\nstring file\nstring function\nuint32 line\n";

impl Schema {
    /// As ROS 2 names it.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Image => "sensor_msgs/msg/Image",
            Self::JointState => "sensor_msgs/msg/JointState",
            Self::Numbers => "std_msgs/msg/Float64MultiArray",
            Self::Text => "std_msgs/msg/String",
            Self::Event => "rcl_interfaces/msg/Log",
        }
    }

    /// Its definition, and those it refers to.
    pub(super) fn definition(self) -> String {
        let parts: &[&str] = match self {
            Self::Image => &[IMAGE, HEADER, TIME],
            Self::JointState => &[JOINT_STATE, HEADER, TIME],
            Self::Numbers => &[NUMBERS, LAYOUT, DIMENSION],
            Self::Text => &["string data\n"],
            Self::Event => &[LOG, TIME],
        };
        parts.join(&format!("{}\n", "=".repeat(80)))
    }
}

/// Which of a `JointState`'s three arrays numbers are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum JointField {
    Position,
    Velocity,
    Effort,
}

/// Seconds are 32 bits wide in ROS: what lies beyond is shown as the last one.
fn stamped(message: Cdr, time_ns: u64) -> Cdr {
    let seconds = i32::try_from(time_ns / 1_000_000_000).unwrap_or(i32::MAX);
    message.i32(seconds).u32((time_ns % 1_000_000_000) as u32)
}

/// A picture of `channels` bytes a pixel, rows first.
pub(super) fn image(time_ns: u64, frame: &str, [rows, columns]: [usize; 2], data: &[u8]) -> Vec<u8> {
    let channels = data.len() / (rows * columns).max(1);
    let encoding = if channels == 3 { "rgb8" } else { "mono8" };
    let message = stamped(Cdr::new(), time_ns).string(frame).u32(rows as u32).u32(columns as u32);
    message.string(encoding).u8(0).u32((columns * channels) as u32).bytes(data).finish()
}

pub(super) fn joint_state(time_ns: u64, names: &[String], field: JointField, values: &[f32]) -> Vec<u8> {
    let message = stamped(Cdr::new(), time_ns).string("").strings(names);
    let of = |wanted| if field == wanted { values } else { &[] };
    message
        .f64s(of(JointField::Position))
        .f64s(of(JointField::Velocity))
        .f64s(of(JointField::Effort))
        .finish()
}

/// A row of numbers, whose label is the names of its elements.
pub(super) fn numbers(label: &str, values: &[f32]) -> Vec<u8> {
    let count = values.len() as u32;
    Cdr::new().u32(1).string(label).u32(count).u32(count).u32(0).f64s(values).finish()
}

pub(super) fn text(text: &str) -> Vec<u8> {
    Cdr::new().string(text).finish()
}

/// How grave an event is, as in `rcl_interfaces/msg/Log`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Level {
    Info = 20,
    Warn = 30,
    Error = 40,
}

pub(super) fn event(time_ns: u64, level: Level, said: &str) -> Vec<u8> {
    let message = stamped(Cdr::new(), time_ns).u8(level as u8).string("rcwm").string(said);
    message.string("").string("").u32(0).finish()
}
