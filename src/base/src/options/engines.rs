//! The choices that the engines offer: they know nothing of options themselves.

use super::{Choice, Kind, Value};
use rowgram_optim::{
    descent::Order,
    nlls::{LinearSolver, Method},
};

macro_rules! engine_choices {
    ($name:ident: $($variant:ident),*) => {
        impl Choice for $name {
            fn all() -> Vec<Self> {
                vec![$($name::$variant),*]
            }
        }
        impl Value for $name {
            fn kind() -> Kind {
                Kind::Words(Self::all().iter().map(Choice::word).collect())
            }
        }
    };
}

engine_choices!(Order: Cyclic, Shuffled);
engine_choices!(LinearSolver: Auto, Schur, IterativeSchur, Sparse, Dense);
engine_choices!(Method: LevenbergMarquardt, Dogleg);
