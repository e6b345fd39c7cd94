//! The robot's end of the link: opened, asked for what its interface says, stopped, closed.

mod observation;
mod own_loop;
mod serve;

use std::ffi::{CString, c_char};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use rcwm_models::interface::Interface;
use rcwm_models::wire::{Format, LinkSettings, SimulatorLink};

pub use observation::*;
pub use own_loop::*;
pub use serve::*;

use crate::border::{Fill, Guarded, border, growing, handle, options, place, text};
use crate::code::{Code, Failure};
use crate::policy::c_text;
use own_loop::Own;

/// The robot's end of a link. One thread at a time; it may be another one each time.
pub struct RobotHandle {
    /// Apart from all else: a signal handler sets it.
    stop: AtomicBool,
    link: Guarded<Connected>,
    /// What cannot change is read by any thread.
    interface: Interface,
    interface_text: CString,
}

/// None once it was served or has failed.
struct Connected(Option<Linked>);

struct Linked {
    link: SimulatorLink,
    own: Own,
}

// SAFETY: a link is bound to its thread only by counters of references (`Rc`) that are not atomic. All that count the same lie within this
// link, none leaves it, and `Guarded` lets one thread at a time at it.
unsafe impl Send for Connected {}

impl Connected {
    fn get(&mut self) -> Result<&mut Linked, Failure> {
        self.0.as_mut().ok_or_else(closed)
    }
}

fn closed() -> Failure {
    let text = "the link is closed: a robot is served once; close this handle and open another";
    Failure::new(Code::RcwmErrorState, text)
}

/// Which link, and what the robot offers.
#[derive(Debug, Clone, Copy)]
#[repr(C)]
pub struct RobotOptions {
    /// sizeof(rcwm_robot_options).
    pub size: usize,
    /// Name of the link: the controller's --instance.
    pub instance: *const c_char,
    /// Path of the robot's robot.toml; null where interface_text is given.
    pub interface_file: *const c_char,
    /// The text of a robot.toml; null where interface_file is given.
    pub interface_text: *const c_char,
    /// Prefix of all files in shared memory; null: the variable RCWM_PREFIX, as all programs do.
    pub prefix: *const c_char,
}

growing!(RobotOptions, "rcwm_robot_options", prefix);

/// What a robot offers.
#[derive(Debug, Clone, Copy)]
#[repr(C)]
pub struct RobotInfo {
    /// sizeof(rcwm_robot_info).
    pub size: usize,
    /// Its interface in one form only: equal interfaces have equal texts. Valid until the robot is closed.
    pub interface_text: *const c_char,
    /// Decisions a second.
    pub rate_hz: f64,
    /// Numbers of all states together.
    pub state_numbers: usize,
    /// Numbers of an action.
    pub action_numbers: usize,
    pub cameras: usize,
}

growing!(RobotInfo, "rcwm_robot_info", cameras);

unsafe fn read_interface(options: &RobotOptions) -> Result<Interface, Failure> {
    match (options.interface_file.is_null(), options.interface_text.is_null()) {
        (false, true) => {
            // SAFETY: a text of the caller's.
            let file = unsafe { text(options.interface_file, "interface_file") }?;
            Ok(Interface::read(Path::new(file))?)
        }
        (true, false) => {
            // SAFETY: a text of the caller's.
            let text = unsafe { text(options.interface_text, "interface_text") }?;
            Interface::parse(text).map_err(|error| Failure::new(Code::RcwmErrorInterface, error.to_string()))
        }
        (none, _) => {
            let found = if none { "neither" } else { "both" };
            Err(Failure::argument(format!("{found} of interface_file and interface_text, expected one")))
        }
    }
}

/// Opens the link in shared memory and says what the robot offers. Either side may start first.
///
/// robot: gets the handle, null where it fails.
/// Fails with RCWM_ERROR_INTERFACE, RCWM_ERROR_LINK or RCWM_ERROR_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rcwm_robot_open(options: *const RobotOptions, robot: *mut *mut RobotHandle) -> Code {
    border(|| {
        // SAFETY: a place of the caller's, or null.
        let robot = unsafe { place(robot, "robot") }?;
        robot.write(std::ptr::null_mut());
        // SAFETY: a struct of the caller's, or null.
        let options = unsafe { self::options(options) }?;
        // SAFETY: a text of the caller's, or null.
        let instance = unsafe { text(options.instance, "instance") }?;
        let mut settings = LinkSettings::new(instance);
        if !options.prefix.is_null() {
            // SAFETY: a text of the caller's.
            settings.prefix = Some(unsafe { text(options.prefix, "prefix") }?.to_owned());
        }
        // SAFETY: texts of the caller's, or null.
        let interface = unsafe { read_interface(&options) }?;
        let format = Format::of(interface.clone());
        let link = SimulatorLink::open(settings, &format)?;
        let linked = Linked { link, own: Own::new(&format) };
        let opened = RobotHandle {
            stop: AtomicBool::new(false),
            link: Guarded::new(Connected(Some(linked))),
            interface_text: c_text(&interface.canonical()),
            interface,
        };
        robot.write(Box::into_raw(Box::new(opened)));
        Ok(())
    })
}

/// What the robot offers. Any thread, at any time, in callbacks too.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rcwm_robot_get_info(robot: *const RobotHandle, info: *mut RobotInfo) -> Code {
    border(|| {
        // SAFETY: a handle of the caller's, or null.
        let RobotHandle { interface, interface_text, .. } = unsafe { handle(robot, "robot") }?;
        // SAFETY: a struct of the caller's, or null.
        let info = unsafe { Fill::new(info) }?;
        info.with(&RobotInfo {
            size: size_of::<RobotInfo>(),
            interface_text: interface_text.as_ptr(),
            rate_hz: interface.rate_hz,
            state_numbers: interface.state_numbers(),
            action_numbers: interface.action_numbers(),
            cameras: interface.camera.len(),
        });
        Ok(())
    })
}

/// Where among rcwm_observation.state the numbers of a state are. Any thread, at any time, in callbacks too.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rcwm_robot_find_state(
    robot: *const RobotHandle,
    name: *const c_char,
    first: *mut usize,
    count: *mut usize,
) -> Code {
    border(|| {
        // SAFETY: a handle of the caller's, or null.
        let RobotHandle { interface, .. } = unsafe { handle(robot, "robot") }?;
        // SAFETY: a text of the caller's, or null.
        let name = unsafe { text(name, "name") }?;
        // SAFETY: places of the caller's, or null.
        let (first, count) = unsafe { (place(first, "first")?, place(count, "count")?) };
        let names = || interface.state.iter().map(|state| &*state.name);
        let range = interface.state_range(name).ok_or_else(|| unknown("state", name, names()))?;
        first.write(range.start);
        count.write(range.len());
        Ok(())
    })
}

/// Where among rcwm_observation.cameras a camera is. Any thread, at any time, in callbacks too.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rcwm_robot_find_camera(
    robot: *const RobotHandle,
    name: *const c_char,
    index: *mut usize,
) -> Code {
    border(|| {
        // SAFETY: a handle of the caller's, or null.
        let RobotHandle { interface, .. } = unsafe { handle(robot, "robot") }?;
        // SAFETY: a text of the caller's, or null.
        let name = unsafe { text(name, "name") }?;
        // SAFETY: a place of the caller's, or null.
        let index = unsafe { place(index, "index") }?;
        let names = || interface.camera.iter().map(|camera| &*camera.name);
        let found = names().position(|camera| camera == name);
        index.write(found.ok_or_else(|| unknown("camera", name, names()))?);
        Ok(())
    })
}

fn unknown<'a>(what: &str, name: &str, names: impl Iterator<Item = &'a str>) -> Failure {
    let names = names.collect::<Vec<_>>().join(", ");
    let names = if names.is_empty() { "none".to_owned() } else { names };
    Failure::argument(format!("{what} {name:?}: the robot has {names}"))
}

/// Ends rcwm_robot_serve() within 100 ms: the controller is told, and the robot gets its safe action. From any thread, from a callback,
/// and from a signal handler (it stores one atomic number); before rcwm_robot_serve(), that ends at once. Null does nothing. The robot
/// must not be closed meanwhile.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rcwm_robot_stop(robot: *const RobotHandle) {
    // SAFETY: a handle of the caller's that is not closed yet, or null.
    if let Some(robot) = unsafe { robot.as_ref() } {
        robot.stop.store(true, Ordering::Relaxed);
    }
}

/// Tells the controller that no further observation comes, and frees the robot; null does nothing. While another thread is in a call, or in
/// a callback, it fails with RCWM_ERROR_STATE, and nothing is freed. RCWM_ERROR_LINK: it is freed, but the controller could not be told.
/// A robot with a loop of its own must have come to rest before: see rcwm_robot_rest().
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rcwm_robot_close(robot: *mut RobotHandle) -> Code {
    border(|| {
        if robot.is_null() {
            return Ok(());
        }
        // SAFETY: a handle of the caller's.
        unsafe { handle(robot, "robot") }?.link.check_free()?;
        // SAFETY: made by `rcwm_robot_open` from a box, and nobody uses it any more.
        let RobotHandle { link, .. } = *unsafe { Box::from_raw(robot) };
        let Connected(linked) = link.into_inner();
        Ok(linked.map_or(Ok(()), |linked| linked.link.close())?)
    })
}
