//! How other implementations' names become ours.

/// What a tensor of a file is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Meaning {
    /// A parameter of ours, or a piece of one.
    Parameter(String, Piece),
    /// The tensor of this name once more, where it is the same one.
    CopyOf(String),
    /// Kept beside the model.
    NotOfTheModel,
    Unknown,
}

/// Which piece of a parameter a tensor is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Piece {
    Whole,
    /// The rows of an actor's output that give the mean.
    Mean,
    /// Those that give the spread.
    Spread,
    /// The colours of a decoder's last layer, without a mask.
    Picture,
}

/// The name of what both implementations keep under several names.
pub(super) fn original(name: &str) -> Option<String> {
    if let Some(rest) = name.strip_prefix("_expl_behavior.") {
        let within = format!("_task_behavior.{rest}");
        return Some(original(&within).unwrap_or(within));
    }
    name.strip_prefix("_task_behavior._world_model.").map(|rest| format!("_wm.{rest}"))
}

/// How the layers of a part are numbered.
#[derive(Debug, Clone, Copy)]
pub(super) enum Layers {
    /// The rest of the name is ours.
    Same,
    /// 0 linear, 1 norm.
    Dense,
    /// 0 linear, 1 norm, 3 linear, 4 norm.
    Mlp,
    /// 0 convolution, 1 norm, 3 convolution, and so on.
    Convolutions,
}

/// A part: how its tensors' names begin there and here.
pub(super) type Rule = (&'static str, &'static str, Layers);

/// Our name of a tensor by the first rule that knows it.
pub(super) fn by_rules(name: &str, rules: &[Rule]) -> Option<String> {
    rules.iter().find_map(|(theirs, ours, layers)| {
        let rest = layers.translate(name.strip_prefix(theirs)?)?;
        Some(format!("{ours}{rest}"))
    })
}

impl Layers {
    fn translate(self, rest: &str) -> Option<String> {
        if let Self::Same = self {
            return Some(rest.to_owned());
        }
        let (number, rest) = rest.split_once('.')?;
        let number: usize = number.parse().ok()?;
        let (layer, within) = (number / 3, number % 3);
        Some(match (self, within) {
            (Self::Dense, 0) if layer == 0 => format!("linear.{rest}"),
            (Self::Dense, 1) if layer == 0 => format!("norm.{rest}"),
            (Self::Mlp, 0) => format!("{layer}.linear.{rest}"),
            (Self::Mlp, 1) => format!("{layer}.norm.{rest}"),
            (Self::Convolutions, 0) => format!("{layer}.conv.{rest}"),
            (Self::Convolutions, 1) => format!("{layer}.norm.{}", rest.strip_prefix("norm.")?),
            _ => return None,
        })
    }
}
