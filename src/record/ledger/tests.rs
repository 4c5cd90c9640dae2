//! What must hold of the books, whatever was lost on the way.

use super::*;
use crate::sensors::Sensor;

const MACHINE: &str = "a";
const BOOT: BootId = BootId(7);
const POSE: Topic = Topic::Pose;
const IMU: Topic = Topic::Sensor(Sensor::Imu);

/// Seeded dice (SplitMix64).
struct Dice(u64);

impl Dice {
    fn below(&mut self, end: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mixed = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (mixed ^ (mixed >> 31)) % end
    }
}

/// A boot, whether it runs, and first and last message of its topics. What was before is overwritten.
type Held<'a> = (u64, bool, &'a [(Topic, [u64; 2])]);

fn holding(boots: &[Held<'_>]) -> Holdings {
    let held = |(boot, current, topics): &Held<'_>| HeldBoot {
        boot: BootId(*boot),
        current: *current,
        topics: topics.iter().copied().collect(),
        overwritten: topics
            .iter()
            .filter(|(_, [first, _])| *first > 0)
            .map(|(of, [n, _])| (*of, *n))
            .collect(),
        unread: false,
    };
    Holdings { kept: Kept::Yes, boots: boots.iter().map(held).collect() }
}

type Lost = (u64, Range<u64>, GapCause);

fn causes(gaps: &[Gap]) -> Vec<Lost> {
    gaps.iter().map(|gap| (gap.boot.0, gap.range.clone(), gap.cause)).collect()
}

fn admit(ledger: &mut Ledger, boot: u64, topic: Topic, numbers: Range<u64>) {
    numbers.for_each(|number| assert!(ledger.admit(MACHINE, BootId(boot), topic, number)));
}

#[test]
fn message_counts_once_and_again_only_if_its_file_is_lost() {
    let mut ledger = Ledger::default();
    admit(&mut ledger, 7, POSE, 0..10);
    assert!(!ledger.admit(MACHINE, BOOT, POSE, 3));
    ledger.synced();
    admit(&mut ledger, 7, POSE, 10..15);
    ledger.revoke();
    assert!(!ledger.admit(MACHINE, BOOT, POSE, 9));
    admit(&mut ledger, 7, POSE, 12..20);
    ledger.synced();
    assert_eq!(ledger.counts(MACHINE), GapCounts { open: 2, filled: 0, lost: 0 });
    let plan = ledger.plan(MACHINE, &holding(&[(7, true, &[(POSE, [0, 30])])]), None);
    assert_eq!(plan.wanted, [(BOOT, [(POSE, vec![[10, 11]])].into())]);
    assert_eq!((plan.count(), plan.lost), (2, vec![]));
}

#[test]
fn last_messages_are_fetched_if_they_do_not_come_by_themselves() {
    let mut ledger = Ledger::default();
    admit(&mut ledger, 7, POSE, 0..10);
    let before = holding(&[(7, true, &[(POSE, [0, 12])])]);
    assert_eq!(ledger.plan(MACHINE, &before, None), Plan::default());
    let now = holding(&[(7, true, &[(POSE, [0, 40]), (IMU, [0, 5])])]);
    let plan = ledger.plan(MACHINE, &now, Some(&before));
    assert_eq!(plan.wanted, [(BOOT, [(POSE, vec![[10, 12]])].into())]);
    // The boot has ended: nothing more will come by itself.
    let after = holding(&[(7, false, &[(POSE, [0, 40]), (IMU, [0, 5])]), (8, true, &[])]);
    let plan = ledger.plan(MACHINE, &after, Some(&now));
    assert_eq!(plan.wanted, [(BOOT, [(POSE, vec![[10, 40]]), (IMU, vec![[0, 5]])].into())]);
}

#[test]
fn boots_that_nobody_saw_are_fetched_and_what_came_before_is_no_gap() {
    let mut ledger = Ledger::default();
    admit(&mut ledger, 3, POSE, 700..710);
    // Boot 1 has lost its beginning before anybody met the machine; of boot 3 some is still there.
    let now = holding(&[
        (1, false, &[(POSE, [50, 99])]),
        (2, false, &[(POSE, [0, 4])]),
        (3, true, &[(POSE, [600, 800])]),
    ]);
    let plan = ledger.plan(MACHINE, &now, None);
    let poses = |range| Wanted::from([(POSE, vec![range])]);
    assert_eq!(
        plan.wanted,
        [(BootId(1), poses([50, 99])), (BootId(2), poses([0, 4])), (BootId(3), poses([600, 699]))]
    );
    assert_eq!((plan.lost, ledger.counts(MACHINE)), (vec![], GapCounts::default()));
    // A boot after that: its beginning is missing, and gone.
    let later = holding(&[(3, false, &[(POSE, [600, 800])]), (4, true, &[(POSE, [20, 90])])]);
    let plan = ledger.plan(MACHINE, &later, Some(&now));
    assert_eq!(plan.lost.len(), 1);
    assert_eq!((plan.lost[0].range.clone(), plan.lost[0].cause), (0..20, GapCause::Overwritten));
    assert_eq!(plan.lost[0].entries()["to"], "19");
    assert_eq!(ledger.plan(MACHINE, &later, Some(&later)).lost, [], "told once");
}

#[test]
fn what_cannot_be_had_is_lost_with_its_cause() {
    let mut ledger = Ledger::default();
    admit(&mut ledger, 1, POSE, 0..1);
    for boot in [2, 3] {
        admit(&mut ledger, boot, POSE, 0..5);
        admit(&mut ledger, boot, POSE, 10..15);
    }
    ledger.synced();
    assert_eq!(ledger.counts(MACHINE).open, 10);
    let now = holding(&[(3, false, &[(POSE, [0, 7])]), (4, true, &[])]);
    // Boot 2 is gone, but is not believed to be until it was asked for twice.
    let plan = ledger.plan(MACHINE, &now, None);
    assert_eq!(plan.wanted, [(BootId(3), [(POSE, vec![[5, 7]])].into())]);
    assert_eq!(causes(&plan.lost), [(3, 8..10, GapCause::NotOnBoard)]);
    let lost = causes(&ledger.plan(MACHINE, &now, Some(&now)).lost);
    assert_eq!(lost, [(2, 5..10, GapCause::NotOnBoard)], "nothing was ever overwritten");
    assert_eq!(ledger.counts(MACHINE), GapCounts { open: 3, filled: 0, lost: 7 });
    assert_eq!(causes(&ledger.open_gaps()), [(3, 5..8, GapCause::Unreachable)]);
    assert_eq!(ledger.open_gaps().len(), 1, "not told so far");
    ledger.open_gaps_were_told();
    assert_eq!(ledger.open_gaps(), [], "told once");
    let none = Holdings { kept: Kept::No, boots: vec![] };
    assert_eq!(ledger.plan(MACHINE, &Holdings { kept: Kept::NotNow, ..none.clone() }, Some(&none)).lost, []);
    let lost = causes(&ledger.plan(MACHINE, &none, Some(&none)).lost);
    assert_eq!(lost, [(3, 5..8, GapCause::NotKept)]);
    // It comes after all.
    admit(&mut ledger, 3, POSE, 5..8);
    ledger.synced();
    assert_eq!(ledger.counts(MACHINE), GapCounts { open: 0, filled: 0, lost: 7 });
}

#[test]
fn books_survive_as_text_and_numbers_past_32_bits() {
    let mut ledger = Ledger::default();
    let far = u64::from(u32::MAX);
    admit(&mut ledger, 7, POSE, 0..1);
    admit(&mut ledger, 7, POSE, far - 5..far + 5);
    admit(&mut ledger, 9, IMU, 0..3);
    ledger.synced();
    let text = serde_json::to_string(&ledger).expect("JSON");
    let mut back: Ledger = serde_json::from_str(&text).expect("own text");
    assert_eq!(back, ledger);
    (far + 5..far + 9).for_each(|number| back.found(MACHINE, BOOT, POSE, number as u32));
    assert!(!back.admit(MACHINE, BOOT, POSE, far + 8) && back.admit(MACHINE, BOOT, POSE, far + 9));
}

#[test]
fn what_was_overwritten_is_told_from_what_never_was_on_board() {
    let mut ledger = Ledger::default();
    admit(&mut ledger, 1, POSE, 0..1);
    let mut one = holding(&[(1, false, &[(POSE, [0, 0])]), (2, true, &[])]);
    // The first second of the boot did not reach the disk; nothing of its odometry did.
    one.boots[1].topics = [(POSE, [90, 400])].into();
    [(POSE, 300), (IMU, 20), (IMU, 30)]
        .into_iter()
        .for_each(|(topic, n)| admit(&mut ledger, 2, topic, n..n + 1));
    let plan = ledger.plan(MACHINE, &one, Some(&one));
    assert_eq!(causes(&plan.lost), [(2, 0..90, GapCause::NotOnBoard)]);
    // Then the ring goes on: up to 200 everything goes.
    one.boots[1].topics = [(POSE, [210, 400])].into();
    one.boots[1].overwritten = [(POSE, 200), (IMU, 25)].into();
    one.boots[1].current = false;
    let plan = ledger.plan(MACHINE, &one, Some(&one));
    let (overwritten, never) = (GapCause::Overwritten, GapCause::NotOnBoard);
    let expected = [(2, 90..200, overwritten), (2, 200..210, never), (2, 0..20, overwritten)];
    assert_eq!(causes(&plan.lost), [&expected[..], &[(2, 21..25, overwritten), (2, 25..30, never)]].concat());
    assert_eq!(plan.wanted, [(BootId(2), [(POSE, vec![[210, 299], [301, 400]])].into())]);
    // An answer lacks some, of which the machine has overwritten a part meanwhile.
    let lacking = BTreeMap::from([(POSE, Ranges::from(vec![(210, 230), (310, 312)]))]);
    one.boots[1].overwritten = [(POSE, 220)].into();
    one.boots[1].unread = true;
    assert_eq!(ledger.not_there(MACHINE, BootId(2), &lacking, &one), [], "perhaps another time");
    one.boots[1].unread = false;
    let lost = ledger.not_there(MACHINE, BootId(2), &lacking, &one);
    assert_eq!(causes(&lost), [(2, 210..220, overwritten), (2, 220..230, never), (2, 310..312, never)]);
    // A boot that was held, and is gone.
    admit(&mut ledger, 2, POSE, 500..501);
    let later = holding(&[(3, true, &[])]);
    let lost = causes(&ledger.plan(MACHINE, &later, Some(&later)).lost);
    assert!(
        lost.len() > 2 && lost.iter().all(|(boot, _, cause)| (*boot, *cause) == (2, overwritten)),
        "{lost:?}"
    );
}

#[test]
fn nothing_is_lost_of_a_boot_of_which_something_cannot_be_read_now() {
    let mut ledger = Ledger::default();
    admit(&mut ledger, 1, POSE, 0..1);
    [(POSE, 300), (IMU, 20)].into_iter().for_each(|(topic, n)| admit(&mut ledger, 2, topic, n..n + 1));
    let mut now = holding(&[(2, false, &[(POSE, [90, 200])]), (3, true, &[])]);
    now.boots[0].unread = true;
    let plan = ledger.plan(MACHINE, &now, Some(&now));
    assert_eq!((plan.count(), plan.lost), (111, vec![]));
    now.boots[0].unread = false;
    assert_eq!(ledger.plan(MACHINE, &now, Some(&now)).lost.len(), 3);
}

#[test]
fn what_was_overwritten_before_the_machine_was_met_is_no_gap() {
    let now = holding(&[(5, true, &[(POSE, [600, 800]), (IMU, [70, 90])])]);
    // Nothing has come so far; then a pose has.
    for first in [None, Some(790)] {
        let mut ledger = Ledger::default();
        first.into_iter().for_each(|number| admit(&mut ledger, 5, POSE, number..number + 1));
        for before in [None, Some(&now)] {
            let plan = ledger.plan(MACHINE, &now, before);
            assert_eq!((plan.lost, ledger.counts(MACHINE).lost), (vec![], 0), "{first:?}");
        }
        admit(&mut ledger, 5, IMU, 80..81);
        assert_eq!(ledger.counts(MACHINE).open, 10);
        // What was there then, and is overwritten before it could be fetched, is one.
        let later = holding(&[(5, true, &[(POSE, [700, 900]), (IMU, [75, 95])])]);
        let lost = causes(&ledger.plan(MACHINE, &later, Some(&now)).lost);
        let of_imu = (5, 70..75, GapCause::Overwritten);
        assert!(lost.contains(&of_imu) && lost.iter().all(|(_, range, _)| range.start != 0), "{lost:?}");
    }
}

#[test]
fn boots_that_are_held_no_more_are_forgotten_but_not_the_count_nor_their_names() {
    let mut ledger = Ledger::default();
    let boots = CLOSED_MAX as u64 + 100;
    let mut largest = 0;
    for boot in 0..boots {
        admit(&mut ledger, boot, POSE, 0..1);
        admit(&mut ledger, boot, POSE, 3..4);
        ledger.synced();
        // The first one is held to the end.
        let now = match boot {
            0 => holding(&[(0, true, &[(POSE, [0, 0])])]),
            _ => holding(&[(0, false, &[(POSE, [0, 3])]), (boot, true, &[(POSE, [0, 0])])]),
        };
        ledger.plan(MACHINE, &now, Some(&now));
        largest = largest.max(serde_json::to_vec(&ledger.machines).expect("JSON").len());
    }
    let book = &ledger.machines[MACHINE];
    let held = [0, boots - 1].map(BootId);
    assert_eq!((&book.order[..], book.boots.len()), (&held[..], held.len()));
    assert_eq!((book.closed.len(), book.closed.back()), (CLOSED_MAX, Some(&BootId(boots - 2))));
    // Sixteen digits, quotes and a comma for each name, and little else.
    assert!(largest < 19 * CLOSED_MAX + 1_000, "{largest} bytes");
    // Of all but the one that is held and the one that runs; of the first of them what may still be fetched.
    let expected = GapCounts { open: 4, filled: 0, lost: 2 * (boots - 2) };
    assert_eq!(ledger.counts(MACHINE), expected);

    // A file is read again, and the machine's disk, which was away, has the boot again.
    let closed = boots - 2;
    ledger.found(MACHINE, BootId(closed), POSE, 3);
    let now = holding(&[(closed, false, &[(POSE, [0, 3])]), (boots, true, &[])]);
    let plan = ledger.plan(MACHINE, &now, Some(&now));
    assert_eq!(plan.wanted, [], "it was recorded, or given up");
    assert!(plan.lost.iter().all(|gap| gap.boot != BootId(closed)), "{:?}", plan.lost);
}

#[test]
fn what_is_lost_waits_until_a_recording_tells_of_it() {
    let mut ledger = Ledger::default();
    admit(&mut ledger, 7, POSE, 0..10);
    ledger.lose(MACHINE, BOOT, POSE, &Ranges::from(vec![(5, 12), (20, 21)]), GapCause::NotOnBoard);
    let text = serde_json::to_string(&ledger).expect("JSON");
    let mut back: Ledger = serde_json::from_str(&text).expect("own text");
    let never = GapCause::NotOnBoard;
    assert_eq!(causes(back.untold()), [(7, 10..12, never), (7, 20..21, never)]);
    back.were_told(1);
    assert_eq!(causes(back.untold()), [(7, 20..21, never)]);
    back.were_told(1);
    assert_eq!(back.untold(), []);
}

/// The topics of a boot of which all is overwritten.
fn all_gone(
    made: &BTreeMap<u64, BTreeMap<Topic, u64>>,
    forgotten: &BTreeMap<(u64, Topic), u64>,
    boot: u64,
) -> Vec<(Topic, u64)> {
    let ends = made[&boot].iter().map(|(topic, end)| (*topic, *end));
    ends.filter(|(topic, end)| *end > 0 && forgotten.get(&(boot, *topic)) == Some(end)).collect()
}

/// A machine that makes messages, a network that loses and repeats them, a recorder whose files are lost now and
/// then, a ring that forgets, restarts of all: in the end everything is there once, or known to be lost.
#[test]
fn after_random_losses_everything_is_there_once_or_known_to_be_lost() {
    for seed in 0..200 {
        let mut dice = Dice(seed);
        let mut ledger = Ledger::default();
        // What the files hold, and what they hold that is not on the disk.
        let mut disk: BTreeMap<(u64, Topic), Vec<u64>> = BTreeMap::new();
        let mut memory: Vec<((u64, Topic), u64)> = Vec::new();
        let mut made: BTreeMap<u64, BTreeMap<Topic, u64>> = BTreeMap::new();
        let mut forgotten: BTreeMap<(u64, Topic), u64> = BTreeMap::new();
        let mut before: Option<Holdings> = None;
        let mut told: BTreeMap<(u64, Topic), Ranges> = BTreeMap::new();
        let mut shown: BTreeSet<BootId> = BTreeSet::new();
        let mut boot = 0;
        let (mut cut, mut lossy) = (false, 10);
        // So that it was met from the start on.
        [POSE, IMU].into_iter().for_each(|topic| {
            ledger.admit(MACHINE, BootId(0), topic, 0);
            memory.push(((0, topic), 0));
            made.entry(0).or_default().insert(topic, 1);
        });
        for step in 0..3_000 {
            let last = step >= 2_990;
            match dice.below(200) {
                0 if !last => boot += 1,
                1 if !last => cut = !cut,
                2 => lossy = 2 + dice.below(50),
                3 if !last => {
                    ledger.revoke();
                    memory.clear();
                }
                4 if !last => {
                    // A restart of the site: the books are those of some time before, the files are read again.
                    memory.clear();
                    let text = serde_json::to_string(&ledger).expect("JSON");
                    ledger = serde_json::from_str(&text).expect("JSON");
                    before = None;
                    for ((boot, topic), numbers) in &disk {
                        numbers.iter().for_each(|n| ledger.found(MACHINE, BootId(*boot), *topic, *n as u32));
                    }
                }
                5..8 => {
                    let of = (dice.below(boot + 1), if dice.below(2) == 0 { POSE } else { IMU });
                    let end = made.get(&of.0).and_then(|topics| topics.get(&of.1)).copied().unwrap_or(0);
                    let to = forgotten.get(&of).copied().unwrap_or(0) + dice.below(20);
                    forgotten.insert(of, to.min(end));
                }
                8..30 => {
                    ledger.synced();
                    memory.drain(..).for_each(|(of, number)| disk.entry(of).or_default().push(number));
                }
                _ => {}
            }
            for topic in [POSE, IMU] {
                let next = made.entry(boot).or_default().entry(topic).or_insert(0);
                let number = *next;
                *next += 1;
                let copies =
                    if cut || dice.below(lossy) == 0 { 0 } else { 1 + u64::from(dice.below(20) == 0) };
                for _ in 0..copies {
                    if ledger.admit(MACHINE, BootId(boot), topic, number) {
                        memory.push(((boot, topic), number));
                    }
                }
            }
            if dice.below(20) != 0 && !last {
                continue;
            }
            // The end of the link's troubles, and of the machine.
            if step == 2_990 {
                cut = false;
                boot += 1;
                made.entry(boot).or_default();
            }
            if cut {
                continue;
            }
            let held = |boot_of: u64| {
                let topics = made.get(&boot_of)?;
                let range = |(topic, end): (&Topic, &u64)| {
                    let first = forgotten.get(&(boot_of, *topic)).copied().unwrap_or(0);
                    (*end > 0 && (first < *end || boot_of == boot)).then(|| (*topic, [first, *end - 1]))
                };
                let topics: BTreeMap<_, _> = topics.iter().filter_map(range).collect();
                let current = boot_of == boot;
                let gone =
                    |(topic, [first, _]): (&Topic, &[u64; 2])| (*first > 0).then_some((*topic, *first));
                let overwritten = match topics.is_empty() {
                    true => BTreeMap::new(),
                    false => {
                        topics.iter().filter_map(gone).chain(all_gone(&made, &forgotten, boot_of)).collect()
                    }
                };
                let boot = BootId(boot_of);
                let held = HeldBoot { boot, current, topics, overwritten, unread: false };
                (current || !held.topics.is_empty()).then_some(held)
            };
            let now = Holdings { kept: Kept::Yes, boots: (0..=boot).filter_map(held).collect() };
            let plan = ledger.plan(MACHINE, &now, before.as_ref());
            shown.extend(now.boots.iter().filter(|held| !held.topics.is_empty()).map(|held| held.boot));
            for gap in plan.lost {
                let was_held =
                    shown.contains(&gap.boot) || now.boots.iter().any(|of| !of.overwritten.is_empty());
                let cause = if was_held { GapCause::Overwritten } else { GapCause::NotOnBoard };
                assert_eq!(gap.cause, cause, "seed {seed}");
                told.entry((gap.boot.0, gap.topic)).or_default().insert_range(gap.range);
            }
            for (boot, wanted) in plan.wanted {
                for (topic, ranges) in wanted {
                    for number in ranges.iter().flat_map(|[first, last]| *first..=*last) {
                        // A part of it arrives.
                        if last || dice.below(3) > 0 {
                            assert!(ledger.admit(MACHINE, boot, topic, number), "seed {seed}: not wanted");
                            memory.push(((boot.0, topic), number));
                        }
                    }
                }
            }
            before = Some(now);
        }
        ledger.synced();
        memory.drain(..).for_each(|(of, number)| disk.entry(of).or_default().push(number));
        for ((boot, topic), numbers) in &mut disk {
            numbers.sort_unstable();
            assert!(
                numbers.windows(2).all(|pair| pair[0] < pair[1]),
                "seed {seed}: {boot} {topic} has doubles"
            );
        }
        for (boot_of, topics) in made.iter().filter(|(boot_of, _)| **boot_of < boot) {
            for (topic, end) in topics {
                let mut there: Ranges = told.remove(&(*boot_of, *topic)).unwrap_or_default();
                let numbers = disk.get(&(*boot_of, *topic)).cloned().unwrap_or_default();
                numbers.iter().for_each(|number| {
                    there.insert(*number);
                });
                let missing = there.missing_in(0..*end);
                // A boot that was forgotten before anybody asked for it ends where it was last heard of.
                let all_forgotten = forgotten.get(&(*boot_of, *topic)).copied().unwrap_or(0) >= *end;
                let tail = there.end();
                let missing = match all_forgotten {
                    true => missing.without(&Ranges::from(vec![(tail, u64::MAX)])),
                    false => missing,
                };
                assert!(missing.is_empty(), "seed {seed}: {boot_of} {topic}: {missing:?} of {end}");
            }
        }
        assert_eq!(ledger.counts(MACHINE).open, 0, "seed {seed}");
    }
}
