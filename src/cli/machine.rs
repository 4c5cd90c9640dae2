//! `holdfast machine`: one excavator's peer.

use std::error::Error;
use std::path::PathBuf;

use crate::config;
use crate::machine::{self, Options, Source};
use crate::simulate::Scenario;

use super::{BadArguments, logging, must_exist};

/// Run one excavator's peer: estimate its position and publish it to the site
///
/// Readings come from drivers that publish over Zenoh (the default; see link.listen in the machine file),
/// from a simulated excavator (--scenario), or from a log folder or recording played in real time (--play).
/// What is played or simulated is moved in time, so that its first reading arrives now.
///
/// The peer dials the site until it answers; it ends on Ctrl-C, on SIGTERM, or when what is played has ended.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Machine file, such as config/machines/simulated-roof.toml; with --scenario it is the scenario's
    #[arg(long, value_name = "TOML", required_unless_present = "scenario", conflicts_with = "scenario")]
    pub config: Option<PathBuf>,
    /// Simulate a machine of this scenario
    #[arg(long, value_name = "TOML", conflicts_with = "play")]
    pub scenario: Option<PathBuf>,
    /// Play this log folder or MCAP recording
    #[arg(long, value_name = "FOLDER_OR_MCAP")]
    pub play: Option<PathBuf>,
    /// Which machine of the scenario or of the recording; not needed where there is one only
    #[arg(long, value_name = "ID")]
    pub machine: Option<String>,
    /// How fast to play or simulate; at other than 1 the stamps run away from the clock
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, value_parser = super::speed)]
    pub speed: f64,
    /// Zenoh endpoint of the site, such as tcp/192.168.1.10:7447, instead of the machine file's; may be repeated
    #[arg(long, value_name = "ENDPOINT", value_parser = endpoint)]
    pub connect: Vec<String>,
    /// Folder of the on-board record, instead of the machine file's; the machine's is the folder of its id in it
    #[arg(long, value_name = "DIR")]
    pub record: Option<PathBuf>,
}

/// Runs the command until a signal or the end of what is played.
///
/// # Errors
/// A file cannot be used, or the peer cannot be started.
pub fn run(arguments: Arguments) -> Result<(), Box<dyn Error>> {
    logging::start();
    let options = options(arguments)?;
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    runtime.block_on(async {
        let shutdown = shutdown_signal()?;
        machine::run(options, shutdown).await?;
        Ok(())
    })
}

fn options(arguments: Arguments) -> Result<Options, Box<dyn Error>> {
    let Arguments { config, scenario, play, machine: wanted, speed, connect, record } = arguments;
    let (mut machine, source) = match (scenario, config) {
        (Some(path), _) => {
            let scenario = Scenario::load(&path)?;
            let index = choose(&scenario.machine_ids(), wanted.as_deref()).map_err(BadArguments)?;
            let machine = scenario.machines[index].clone();
            (machine, Source::Simulation { scenario: Box::new(scenario), index })
        }
        (None, Some(path)) => {
            let machine: config::Machine = config::load(&path)?;
            let source = match play {
                Some(path) => {
                    must_exist(&path)?;
                    Source::Play { path, recorded_machine: wanted }
                }
                None => Source::Zenoh,
            };
            (machine, source)
        }
        (None, None) => {
            return Err(BadArguments("either --config or --scenario must be given".to_owned()).into());
        }
    };
    if !connect.is_empty() {
        machine.link.connect = connect;
    }
    if let Some(directory) = record {
        machine.record.directory = directory;
    }
    Ok(Options { machine, source, speed })
}

fn endpoint(text: &str) -> Result<String, String> {
    config::endpoint(text).map(|()| text.to_owned())
}

fn choose(ids: &[&str], wanted: Option<&str>) -> Result<usize, String> {
    match wanted {
        None if ids.len() == 1 => Ok(0),
        None => Err(format!("the scenario has several machines; choose with --machine: {}", ids.join(", "))),
        Some(wanted) => ids
            .iter()
            .position(|id| *id == wanted)
            .ok_or_else(|| format!("the scenario has no machine {wanted}, but: {}", ids.join(", "))),
    }
}

/// Resolves on Ctrl-C or SIGTERM; both are caught from now on.
pub(super) fn shutdown_signal() -> std::io::Result<impl Future<Output = ()>> {
    use tokio::signal::unix::{SignalKind, signal};
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut terminate = signal(SignalKind::terminate())?;
    Ok(async move {
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn machine_of_a_scenario_is_chosen_by_its_id() {
        assert_eq!(choose(&["a"], None), Ok(0));
        assert_eq!(choose(&["a", "b"], Some("b")), Ok(1));
        assert!(choose(&["a", "b"], None).expect_err("which").contains("--machine: a, b"));
        assert!(choose(&["a"], Some("c")).expect_err("none").contains("no machine c"));
    }
}
