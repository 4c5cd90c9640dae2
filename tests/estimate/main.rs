//! `holdfast simulate`, `estimate`, `evaluate` and `check`, end to end: how good the estimate is on the shipped
//! scenarios, what bad input does, how it starts, and how it gets through streams that fail.

mod accuracy;
mod bad_input;
#[path = "../support/command.rs"]
mod command;
mod degenerate;
mod degraded;
mod fixtures;
mod imu_gap;
mod outages;
mod receiver;
mod start;
