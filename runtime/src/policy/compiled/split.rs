//! The tick as two graphs in another engine: what can be known before the image is there, and the rest.
//!
//! The same schedule as ours without our operators, so that a comparison tells the two apart.

use rcwm_models::bundle::{Bundle, PartName};
use rcwm_models::onnx::data_type;
use rcwm_models::wire::ActionValues;
use tract_onnx::prelude::TractResult;

use super::super::parts::Parts;
use super::super::tick::{Tick, Work};
use super::super::{Inputs, PolicyError};
use super::pieces::{Place, Values};
use super::places::Places;
use super::run_error;
use crate::compile::{Fact, Segment, halve};
use crate::engine::{self, EngineSettings, Output, Part};

pub(in super::super) struct Split {
    values: Values,
    places: Places,
    early: Half,
    late: Half,
    /// For frames that are imagined: the actor without all that stands before it.
    parts: Parts,
}

struct Half {
    graph: Box<dyn Part>,
    inputs: Vec<Place>,
    outputs: Vec<(Place, Numbers)>,
}

/// What comes out.
enum Numbers {
    I64(Vec<i64>),
    F32(Vec<f32>),
}

impl Split {
    pub(in super::super) fn load(bundle: &Bundle, settings: EngineSettings) -> Result<Self, PolicyError> {
        let [early, late] = halve(bundle)?;
        let mut values = Values::default();
        let mut load = |segment: &Segment| Half::load(segment, settings, &mut values);
        let (early, late) = (load(&early)?, load(&late)?);
        let places = Places::of(bundle.manifest.kind, &values, |place| early.makes(place))?;
        Ok(Self { values, places, early, late, parts: Parts::load(bundle, settings)? })
    }
}

impl Half {
    fn load(segment: &Segment, settings: EngineSettings, values: &mut Values) -> Result<Self, PolicyError> {
        let known = |(name, fact): &(String, Option<Fact>)| Some((name.clone(), fact.clone()?));
        let outputs: Vec<(String, Fact)> = segment.outputs.iter().filter_map(known).collect();
        let graph = engine::load_graph(segment.part, &segment.onnx, [&segment.inputs, &outputs], settings)?;
        let mut place = |(name, fact): &(String, Fact)| -> Result<Place, PolicyError> {
            values.place(name, Some(fact)).map_err(|error| run_error(segment.part, &error))
        };
        let numbers = |fact: &Fact| {
            let count = fact.shape.iter().product();
            if fact.dtype == data_type::INT64 {
                Numbers::I64(vec![0; count])
            } else {
                Numbers::F32(vec![0.0; count])
            }
        };
        Ok(Self {
            graph,
            inputs: segment.inputs.iter().map(&mut place).collect::<Result<_, _>>()?,
            outputs: outputs
                .iter()
                .map(|output| place(output).map(|place| (place, numbers(&output.1))))
                .collect::<Result<_, _>>()?,
        })
    }

    fn makes(&self, place: Place) -> bool {
        self.outputs.iter().any(|(output, _)| *output == place)
    }

    fn run(&mut self, values: &mut Values) -> Result<(), PolicyError> {
        let of = |error| run_error(PartName::Policy, &error);
        let inputs = self.inputs.iter().map(|place| values.input(*place)).collect::<TractResult<Vec<_>>>();
        let mut outputs: Vec<_> = self.outputs.iter_mut().map(|(_, numbers)| numbers.output()).collect();
        self.graph.run(&inputs.map_err(of)?, &mut outputs)?;
        for (place, numbers) in &self.outputs {
            let kept = match numbers {
                Numbers::I64(numbers) => values.fill(Some(*place), numbers),
                Numbers::F32(numbers) => values.fill(Some(*place), numbers),
            };
            kept.map_err(of)?;
        }
        Ok(())
    }
}

impl Numbers {
    fn output(&mut self) -> Output<'_> {
        match self {
            Self::I64(numbers) => Output::I64(numbers),
            Self::F32(numbers) => Output::F32(numbers),
        }
    }
}

impl Tick for Split {
    fn work_ahead(&mut self, action: &ActionValues, work: &mut Work<'_>) -> Result<(), PolicyError> {
        let Self { values, places, early, .. } = self;
        places.fill(values, action, work).map_err(|error| run_error(PartName::Policy, &error))?;
        early.run(values)?;
        work.clock.ended(PartName::Policy);
        places.copy_priors(values, work.buffers)
    }

    fn observe(&mut self, inputs: Inputs<'_>, work: &mut Work<'_>) -> Result<(), PolicyError> {
        let Self { values, places, late, .. } = self;
        places.fill_inputs(values, inputs).map_err(|error| run_error(PartName::Policy, &error))?;
        late.run(values)?;
        work.clock.ended(PartName::Policy);
        places.copy_posteriors(values, work.buffers)?;
        places.copy_decision(values, work.buffers)
    }

    fn imagine(&mut self, work: &mut Work<'_>) -> Result<(), PolicyError> {
        work.buffers.believe_prior();
        self.parts.run_actor(work.buffers)?;
        work.clock.ended(PartName::Actor);
        Ok(())
    }

    fn warm_caches(&mut self) {
        // As ours does it: what comes out is overwritten by whatever comes next.
        let _ = self.late.run(&mut self.values);
    }
}
