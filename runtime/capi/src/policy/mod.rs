//! A bundle that decides, in a program of one's own and without shared memory.

mod facts;
mod types;

use std::ffi::c_char;
use std::slice::from_raw_parts;

use rcwm_models::bundle::Bundle;
use rcwm_models::wire::ActionValues;
use rcwm_runtime::policy::{InputReader, Sampling};
use rcwm_runtime::{EngineKind, EngineSettings, Policy};

pub(crate) use facts::c_text;
pub use types::*;

use crate::border::{Fill, Guarded, border, handle, options, place, slice, text, without_signals};
use crate::code::{Code, Failure};
use facts::Facts;

/// A loaded bundle, and what it carries from tick to tick. One thread at a time; it may be another one each time.
pub struct PolicyHandle {
    loaded: Guarded<Loaded>,
    /// What cannot change is read by any thread.
    facts: Facts,
}

struct Loaded {
    policy: Policy,
    reader: InputReader,
}

/// None at an episode's start.
unsafe fn executed_action(values: *const f32, count: usize) -> Result<Option<ActionValues>, Failure> {
    if values.is_null() && count == 0 {
        return Ok(None);
    }
    // SAFETY: the caller gives so many numbers.
    let values = unsafe { slice(values, count, || "executed".into()) }?;
    let of = ActionValues::of(values);
    of.map(Some).ok_or_else(|| {
        Failure::argument(format!(
            "executed has {count} numbers, at most {RCWM_ACTION_NUMBERS_MAX} are possible"
        ))
    })
}

/// Loads and checks the folder of a bundle (the engine is tract), and runs some ticks on a black picture so that the first real one finds
/// memory and caches ready: takes some 100 ms.
///
/// options: null for what is usual. policy: gets the handle, null where it fails.
/// Fails with RCWM_ERROR_BUNDLE, RCWM_ERROR_ENGINE or RCWM_ERROR_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rcwm_policy_open(
    folder: *const c_char,
    options: *const PolicyOptions,
    policy: *mut *mut PolicyHandle,
) -> Code {
    border(|| {
        // SAFETY: a place of the caller's, or null.
        let policy = unsafe { place(policy, "policy") }?;
        policy.write(std::ptr::null_mut());
        // SAFETY: a text of the caller's, or null.
        let folder = unsafe { text(folder, "folder") }?;
        // SAFETY: a struct of the caller's, or null.
        let PolicyOptions { threads, half_weights, .. } = unsafe { self::options(options) }?;
        let settings = match threads {
            0 => EngineSettings::tract(),
            1 | 2 => EngineSettings::single_threaded(EngineKind::Tract).with_threads(threads as usize),
            _ => return Err(Failure::argument(format!("threads = {threads}, expected 0, 1 or 2"))),
        };
        let settings = settings.with_half_weights(half_weights != 0);
        let bundle = Bundle::open(folder.as_ref()).map_err(rcwm_runtime::PolicyError::from)?;
        let loaded = without_signals(|| Policy::new(&bundle, settings, Sampling::Mode))?;
        let facts = Facts::of(loaded.manifest(), loaded.imagines());
        let reader = InputReader::of(loaded.manifest());
        let loaded = Guarded::new(Loaded { policy: loaded, reader });
        policy.write(Box::into_raw(Box::new(PolicyHandle { loaded, facts })));
        Ok(())
    })
}

/// What the policy is. Any thread, at any time.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rcwm_policy_get_info(policy: *const PolicyHandle, info: *mut PolicyInfo) -> Code {
    border(|| {
        // SAFETY: a handle of the caller's, or null.
        let facts = &unsafe { handle(policy, "policy") }?.facts;
        // SAFETY: a struct of the caller's, or null.
        let info = unsafe { Fill::new(info) }?;
        info.with(&PolicyInfo {
            size: size_of::<PolicyInfo>(),
            interface_text: facts.interface.as_ptr(),
            rate_hz: facts.rate_hz,
            inputs: facts.inputs.len(),
            pictures: facts.pictures().count(),
            states: facts.states().count(),
            action_numbers: facts.action_numbers,
            imagines: facts.imagines.into(),
        });
        Ok(())
    })
}

/// What the policy reads at a place of its inputs, counted from 0. Pictures and states are handed to rcwm_policy_observe() in this order.
/// Any thread, at any time.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rcwm_policy_get_input(
    policy: *const PolicyHandle,
    index: usize,
    input: *mut InputInfo,
) -> Code {
    border(|| {
        // SAFETY: a handle of the caller's, or null.
        let facts = &unsafe { handle(policy, "policy") }?.facts;
        // SAFETY: a struct of the caller's, or null.
        let input = unsafe { Fill::new(input) }?;
        let known = facts.inputs.get(index).ok_or_else(|| {
            Failure::argument(format!("input {index}: the policy has {}, counted from 0", facts.inputs.len()))
        })?;
        let [rows, columns] = known.picture.unwrap_or_default().map(|side| side as u32);
        let kind = if known.picture.is_some() { RCWM_INPUT_PICTURE } else { RCWM_INPUT_STATE };
        let (size, name, len) = (size_of::<InputInfo>(), known.name.as_ptr(), known.len);
        input.with(&InputInfo { size, name, kind, rows, columns, len });
        Ok(())
    })
}

/// Decides on what is observed, and carries the state on.
///
/// pictures, states: those of the policy's inputs, each in their order; what is handed over is read during the call only.
/// executed: what was really executed since the last call, which may be another action than was decided; null and 0 at the first
/// observation of an episode, which starts from the bundle's initial state.
///
/// Fails with RCWM_ERROR_ARGUMENT, RCWM_ERROR_NOT_FINITE or RCWM_ERROR_ENGINE; the carried state is then that of the last good tick, and
/// the next call goes on from there. Allocates nothing but what tract does inside (some ten small pieces).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rcwm_policy_observe(
    policy: *mut PolicyHandle,
    pictures: *const Picture,
    picture_count: usize,
    states: *const Numbers,
    state_count: usize,
    executed: *const f32,
    executed_count: usize,
    decision: *mut Decision,
) -> Code {
    border(|| {
        // SAFETY: a handle of the caller's, or null.
        let PolicyHandle { loaded, facts } = unsafe { handle(policy, "policy") }?;
        // SAFETY: a struct of the caller's, or null.
        let decision = unsafe { Fill::new(decision) }?;
        // SAFETY: so many structs of the caller's, or null.
        let pictures = unsafe { slice(pictures, picture_count, || "pictures".into()) }?;
        // SAFETY: so many structs of the caller's, or null.
        let states = unsafe { slice(states, state_count, || "states".into()) }?;
        Facts::check("picture", facts.pictures(), pictures.iter().map(|picture| picture.len))?;
        Facts::check("state", facts.states(), states.iter().map(|state| state.len))?;
        for (at, Picture { bytes, len }) in pictures.iter().enumerate() {
            // SAFETY: so many bytes of the caller's, or null.
            unsafe { slice(*bytes, *len, || format!("pictures[{at}].bytes")) }?;
        }
        for (at, Numbers { values, len }) in states.iter().enumerate() {
            // SAFETY: so many numbers of the caller's, or null.
            unsafe { slice(*values, *len, || format!("states[{at}].values")) }?;
        }
        // SAFETY: so many numbers of the caller's, or null.
        let executed = unsafe { executed_action(executed, executed_count) }?;
        let decided = loaded.enter(|Loaded { policy, reader }| {
            // SAFETY: looked at above; of no length only where the policy reads none.
            let pictures = pictures.iter().map(|x| unsafe { from_raw_parts(x.bytes, x.len) });
            // SAFETY: as above.
            let states = states.iter().map(|x| unsafe { from_raw_parts(x.values, x.len) });
            Ok(policy.observe(reader.arrange(pictures, states), executed.as_ref())?)
        })?;
        decision.with(&(&decided).into());
        Ok(())
    })
}

/// Computes all of the next tick that needs only the action before it, as if `executed` had been executed: to be called in the idle time
/// after the action was sent. When rcwm_policy_observe() then gets the same action, it has that much less to do; else it does it again.
/// Null and 0: the next observation is the first of an episode. Fails as rcwm_policy_observe().
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rcwm_policy_work_ahead(
    policy: *mut PolicyHandle,
    executed: *const f32,
    executed_count: usize,
) -> Code {
    border(|| {
        // SAFETY: a handle of the caller's, or null.
        let PolicyHandle { loaded, .. } = unsafe { handle(policy, "policy") }?;
        // SAFETY: so many numbers of the caller's, or null.
        let executed = unsafe { executed_action(executed, executed_count) }?;
        loaded.enter(|Loaded { policy, .. }| Ok(policy.work_ahead(executed.as_ref())?))
    })
}

/// Goes on without a picture: the world model imagines the missing frame. A policy without a world model decides on the executed action
/// once more, and its state stays. Fails as rcwm_policy_observe().
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rcwm_policy_imagine(
    policy: *mut PolicyHandle,
    executed: *const f32,
    executed_count: usize,
    decision: *mut Decision,
) -> Code {
    border(|| {
        // SAFETY: a handle of the caller's, or null.
        let PolicyHandle { loaded, .. } = unsafe { handle(policy, "policy") }?;
        // SAFETY: a struct of the caller's, or null.
        let decision = unsafe { Fill::new(decision) }?;
        // SAFETY: so many numbers of the caller's, or null.
        let executed = unsafe { executed_action(executed, executed_count) }?.ok_or_else(|| {
            Failure::argument("executed is null: the first observation of an episode cannot be imagined")
        })?;
        let decided = loaded.enter(|Loaded { policy, .. }| Ok(policy.imagine(&executed)?))?;
        decision.with(&(&decided).into());
        Ok(())
    })
}

/// Gets ready for a picture that will come within a millisecond or so: what stands between picture and action is computed once more from
/// the last picture and dropped, because others have used the caches since. Takes as long as a tick; results do not depend on it.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rcwm_policy_warm_caches(policy: *mut PolicyHandle) -> Code {
    border(|| {
        // SAFETY: a handle of the caller's, or null.
        let PolicyHandle { loaded, .. } = unsafe { handle(policy, "policy") }?;
        loaded.enter(|Loaded { policy, .. }| {
            policy.warm_caches();
            Ok(())
        })
    })
}

/// Frees a policy; null does nothing. While another thread is in a call it fails with RCWM_ERROR_STATE, and nothing is freed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rcwm_policy_close(policy: *mut PolicyHandle) -> Code {
    border(|| {
        if policy.is_null() {
            return Ok(());
        }
        // SAFETY: a handle of the caller's.
        unsafe { handle(policy, "policy") }?.loaded.check_free()?;
        // SAFETY: made by `rcwm_policy_open` from a box, and nobody uses it any more.
        drop(unsafe { Box::from_raw(policy) });
        Ok(())
    })
}
