//! What a measurement was made on.

use serde::{Deserialize, Serialize};

/// The machine, as Linux knows it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Machine {
    /// The processor's name.
    pub processor: String,
    /// Processors that may be used.
    pub cores: usize,
    /// Of the program: `x86_64` or `aarch64`.
    pub architecture: String,
    /// Release of the kernel.
    pub kernel: String,
    /// How the first processor's clock is chosen; `none` where the system does not choose it, as in most virtual machines.
    pub governor: String,
    /// Whether it is a virtual machine, which has neighbours.
    pub virtualised: bool,
}

impl Machine {
    /// This one.
    #[must_use]
    pub fn here() -> Self {
        let first_line = |path| Some(std::fs::read_to_string(path).ok()?.lines().next()?.trim().to_owned());
        let cpuinfo = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
        Self {
            processor: processor(&cpuinfo),
            cores: std::thread::available_parallelism().map_or(1, usize::from),
            architecture: std::env::consts::ARCH.to_owned(),
            kernel: first_line("/proc/sys/kernel/osrelease").unwrap_or_else(|| "unknown".to_owned()),
            governor: first_line("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
                .unwrap_or_else(|| "none".to_owned()),
            virtualised: field(&cpuinfo, "flags")
                .is_some_and(|flags| flags.split(' ').any(|flag| flag == "hypervisor")),
        }
    }
}

/// ARM's kernels give numbers in place of a name; boards say theirs elsewhere.
fn processor(cpuinfo: &str) -> String {
    let board = || std::fs::read_to_string("/proc/device-tree/model").ok();
    let name = field(cpuinfo, "model name").map(str::to_owned).or_else(board);
    name.map_or_else(|| "unknown".to_owned(), |name| name.trim_matches(['\0', ' ', '\n']).to_owned())
}

fn field<'a>(cpuinfo: &'a str, name: &str) -> Option<&'a str> {
    let value = |line: &'a str| {
        let (key, value) = line.split_once(':')?;
        (key.trim() == name).then(|| value.trim())
    };
    cpuinfo.lines().find_map(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_machine_has_a_processor_and_a_kernel() {
        let machine = Machine::here();
        assert!(
            machine.cores > 0 && !machine.processor.is_empty() && machine.kernel.contains('.'),
            "{machine:?}"
        );
        let cpuinfo = "processor\t: 0\nmodel name\t: A Processor @ 2 GHz\nflags\t\t: fpu hypervisor\n";
        assert_eq!(processor(cpuinfo), "A Processor @ 2 GHz");
        assert_eq!(field(cpuinfo, "flags"), Some("fpu hypervisor"));
    }
}
