//! Many runs on all processors, behind a bar.

use std::error::Error;
use std::num::NonZeroUsize;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{RecvTimeoutError, sync_channel};
use std::thread;
use std::time::Duration;

use crate::cli::progress::{Progress, Unit};

/// The bar is looked at so often while nothing is finished.
const LOOK: Duration = Duration::from_millis(200);

/// As many threads as the computer has processors.
pub fn processors() -> NonZeroUsize {
    thread::available_parallelism().unwrap_or(NonZeroUsize::MIN)
}

/// Runs every job, each by itself; results come back in the order of the jobs, whichever thread ran them when.
///
/// # Errors
/// The first job's, in their order, that failed.
pub fn run<J: Sync, T: Send, E: Error + Send + 'static>(
    what: &str,
    jobs: &[J],
    threads: NonZeroUsize,
    run: impl Fn(&J) -> Result<T, E> + Sync,
) -> Result<Vec<T>, Box<dyn Error>> {
    let next = AtomicUsize::new(0);
    let threads = threads.get().min(jobs.len().max(1));
    let mut results: Vec<Option<Result<T, E>>> = jobs.iter().map(|_| None).collect();
    let mut bar = Progress::new(what, Unit::Count("runs"));
    thread::scope(|scope| {
        // One for each thread: who is finished need not wait to begin the next.
        let (sender, finished) = sync_channel(threads);
        for _ in 0..threads {
            let (sender, next, run) = (sender.clone(), &next, &run);
            scope.spawn(move || {
                while let Some((index, job)) = take(next, jobs) {
                    if sender.send((index, run(job))).is_err() {
                        return;
                    }
                }
            });
        }
        drop(sender);
        let mut done = 0;
        loop {
            match finished.recv_timeout(LOOK) {
                Ok((index, result)) => {
                    results[index] = Some(result);
                    done += 1;
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
            bar.show(f64::from(done), jobs.len() as f64);
        }
    });
    bar.finish();
    let results = results.into_iter().flatten().collect::<Result<Vec<T>, E>>()?;
    Ok(results)
}

fn take<'a, J>(next: &AtomicUsize, jobs: &'a [J]) -> Option<(usize, &'a J)> {
    let index = next.fetch_add(1, Ordering::Relaxed);
    Some((index, jobs.get(index)?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_come_in_the_order_of_the_jobs() {
        let jobs: Vec<u64> = (0..100).collect();
        for threads in [1, 3, 200] {
            let threads = NonZeroUsize::new(threads).expect("above zero");
            let squares = run("squaring", &jobs, threads, |job| Ok::<u64, std::fmt::Error>(job * job));
            assert_eq!(squares.expect("no error"), jobs.iter().map(|job| job * job).collect::<Vec<_>>());
        }
        let fails = |job: &u64| if *job == 7 { Err(std::fmt::Error) } else { Ok(()) };
        assert!(run("failing", &jobs, NonZeroUsize::MIN, fails).is_err());
    }
}
