//! holdfast tells a construction site where each of its excavators is, to the centimetre, also when GNSS
//! lets go. `src/README.md` is the map of the rooms; imports only look down.

#[cfg(feature = "shells")]
pub mod accounts;
pub mod baselines;
pub mod batch;
pub mod cli;
pub mod config;
pub mod estimator;
pub mod evaluate;
pub mod export;
pub mod factors;
pub mod fleet;
pub mod frames;
pub mod import;
pub mod lie;
#[cfg(feature = "shells")]
pub mod link;
pub mod live;
#[cfg(feature = "shells")]
pub mod machine;
#[cfg(feature = "shells")]
pub mod player;
pub mod preintegration;
pub mod record;
pub mod reference;
pub mod replay;
pub mod review;
pub mod sensors;
pub mod simulate;
#[cfg(feature = "shells")]
pub mod site;
pub mod smoother;
pub mod state;
pub mod time;
pub mod wire;
