//! What must hold of accounts, with the times given.

use std::path::PathBuf;

use super::*;

const LIMITS: SignInLimits =
    SignInLimits { idle: Span::from_millis(60_000), total: Span::from_millis(600_000) };

struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("holdfast-accounts-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        Self(path)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

fn at(seconds: f64) -> Stamp {
    Stamp::from_seconds(1_790_000_000.0 + seconds)
}

fn password(text: &str) -> Password {
    Password::new(text.to_owned())
}

#[test]
fn only_the_right_password_of_the_right_name_is_right() {
    let folder = Folder::new("password");
    let accounts = Accounts::of(&folder.0).expect("none yet");
    assert!(!accounts.exist().expect("no file"));
    assert!(!accounts.path().exists(), "asking makes no file");
    assert!(accounts.check_password("anna", &password("a long password")).expect("asked").is_none());
    accounts.add_user("Anna", Role::Operator, &password("a long password"), at(0.0)).expect("added");
    assert!(accounts.exist().expect("there"));
    let user = accounts.check_password("anna", &password("a long password")).expect("asked").expect("right");
    assert_eq!((user.name.as_str(), user.role), ("Anna", Role::Operator));
    for (name, wrong) in [("anna", "a long passwore"), ("anna", ""), ("bert", "a long password"), ("", "")] {
        assert!(accounts.check_password(name, &password(wrong)).expect("asked").is_none(), "{name} {wrong}");
    }
    let again = accounts.add_user("ANNA", Role::Viewer, &password("another password"), at(0.0));
    assert!(matches!(again, Err(AccountsError::Taken(_))), "{again:?}");
    for name in ["", "-a", "a b", "ä", "a/b", &"a".repeat(65)] {
        let refused = accounts.add_user(name, Role::Viewer, &password("a long password"), at(0.0));
        assert!(matches!(refused, Err(AccountsError::Invalid(_))), "{name}");
    }
    for wrong in ["short", "long-enough", &"a".repeat(201)] {
        let refused = accounts.add_user("long-enough", Role::Viewer, &password(wrong), at(0.0));
        assert!(matches!(refused, Err(AccountsError::Invalid(_))), "{wrong}");
    }
}

#[test]
fn sign_ins_end_when_idle_old_signed_out_or_with_the_password() {
    let folder = Folder::new("sign-in");
    let accounts = Accounts::of(&folder.0).expect("none yet");
    accounts.add_user("anna", Role::Admin, &password("a long password"), at(0.0)).expect("added");
    let secret = accounts.sign_in("anna", LIMITS, at(0.0)).expect("signed in");
    let good = |secret: &Secret, now| accounts.signed_in(secret, LIMITS, now).expect("asked");
    assert_eq!(good(&secret, at(59.9)).expect("good").0.role, Role::Admin);
    assert_eq!(good(&secret, at(60.0)), None, "idle");
    assert_eq!(good(&Secret::of("nonsense"), at(1.0)), None);
    let mut now = 0.0;
    while now < 590.0 {
        now += 50.0;
        accounts.seen(&secret, at(now)).expect("noted");
    }
    assert!(good(&secret, at(599.0)).is_some());
    assert_eq!(good(&secret, at(600.0)), None, "old");

    let (out, kept) = (accounts.sign_in("anna", LIMITS, at(0.0)), accounts.sign_in("anna", LIMITS, at(0.0)));
    let (out, kept) = (out.expect("signed in"), kept.expect("signed in"));
    let (known, _) = good(&out, at(1.0)).expect("good");
    assert!(accounts.still(&known, LIMITS, at(1.0)).expect("asked"));
    accounts.sign_out(&out).expect("signed out");
    assert!(!accounts.still(&known, LIMITS, at(1.0)).expect("asked"));
    assert!(good(&out, at(1.0)).is_none() && good(&kept, at(1.0)).is_some());
    accounts.set_role("anna", Role::Viewer, false).expect("set");
    assert_eq!(good(&kept, at(1.0)).expect("good").0.role, Role::Viewer, "at once");
    accounts.set_password("anna", &password("another password")).expect("set");
    assert_eq!(good(&kept, at(1.0)), None, "with the password before");
}

#[test]
fn tokens_end_when_expired_revoked_or_with_their_account_and_reach_no_further_than_it() {
    let folder = Folder::new("token");
    let accounts = Accounts::of(&folder.0).expect("none yet");
    accounts.add_user("anna", Role::Operator, &password("a long password"), at(0.0)).expect("added");
    let add = |role, end| accounts.add_token("anna", "for tests", role, at(end), at(0.0));
    let (token, secret) = add(Role::Admin, 100.0).expect("added");
    assert_eq!(token.role, Role::Operator, "not more than its account");
    assert!(secret.reveal().starts_with("hf_") && secret.reveal().len() == 67);
    let good = |secret: &Secret, now| accounts.by_token(secret, now).expect("asked").map(|(known, _)| known);
    assert_eq!(good(&secret, at(99.0)).expect("good").role, Role::Operator);
    assert_eq!(good(&secret, at(100.0)), None, "expired");
    accounts.set_role("anna", Role::Viewer, false).expect("set");
    assert_eq!(good(&secret, at(1.0)).expect("good").role, Role::Viewer, "with its account");
    assert!(accounts.revoke_token(&token.id, Some("bert")).is_err(), "not bert's");
    accounts.revoke_token(&token.id, Some("anna")).expect("revoked");
    assert_eq!(good(&secret, at(1.0)), None, "revoked");
    for end in [0.0, -1.0, 86_400.0 * 4000.0, f64::INFINITY] {
        assert!(matches!(add(Role::Viewer, end), Err(AccountsError::Invalid(_))), "{end}");
    }
    for _ in 0..TOKENS_MAX {
        add(Role::Viewer, 10.0).expect("room");
    }
    assert!(matches!(add(Role::Viewer, 10.0), Err(AccountsError::Invalid(_))), "too many");
    let (_, last) = (accounts.remove_user("anna", false).expect("removed"), secret);
    assert_eq!(good(&last, at(1.0)), None);
    assert_eq!(accounts.tokens(None).expect("asked"), [], "gone with the account");
}

#[test]
fn the_only_admin_stays_where_that_is_asked() {
    let folder = Folder::new("admin");
    let accounts = Accounts::of(&folder.0).expect("none yet");
    accounts.add_user("anna", Role::Admin, &password("a long password"), at(0.0)).expect("added");
    accounts.add_user("bert", Role::Operator, &password("a long password"), at(0.0)).expect("added");
    assert!(matches!(accounts.remove_user("ANNA", true), Err(AccountsError::OnlyAdmin(_))));
    assert!(matches!(accounts.set_role("anna", Role::Viewer, true), Err(AccountsError::OnlyAdmin(_))));
    accounts.set_role("anna", Role::Admin, true).expect("as before");
    assert!(matches!(accounts.remove_user("carl", true), Err(AccountsError::Missing { .. })));
    accounts.set_role("bert", Role::Admin, true).expect("set");
    accounts.remove_user("anna", true).expect("there is another one");
    let names: Vec<_> = accounts.users().expect("asked").into_iter().map(|user| user.name).collect();
    assert_eq!(names, ["bert"]);
}

#[test]
fn another_process_s_changes_are_seen_and_another_file_too() {
    let folder = Folder::new("shared");
    let server = Accounts::of(&folder.0).expect("none yet");
    let command_line = Accounts::of(&folder.0).expect("none yet");
    assert!(!server.exist().expect("asked"));
    command_line.add_user("anna", Role::Admin, &password("a long password"), at(0.0)).expect("added");
    assert!(server.exist().expect("asked"));
    let secret = server.sign_in("anna", LIMITS, at(0.0)).expect("signed in");
    command_line.remove_user("anna", false).expect("removed");
    assert!(!server.exist().expect("asked"));
    assert_eq!(server.signed_in(&secret, LIMITS, at(1.0)).expect("asked"), None);
    for end in ["", "-wal", "-shm"] {
        let _ = std::fs::remove_file(format!("{}{end}", server.path().display()));
    }
    assert!(!server.exist().expect("no file"));
    Accounts::of(&folder.0)
        .and_then(|other| other.add_user("bert", Role::Admin, &password("a long password"), at(0.0)))
        .expect("a new file");
    assert_eq!(server.users().expect("asked").len(), 1);
}

#[test]
fn the_file_is_its_owner_s_alone_holds_no_secret_and_is_never_taken_for_empty() {
    let folder = Folder::new("file");
    let accounts = Accounts::of(&folder.0).expect("none yet");
    accounts.add_user("anna", Role::Admin, &password("a long password"), at(0.0)).expect("added");
    let sign_in = accounts.sign_in("anna", LIMITS, at(0.0)).expect("signed in");
    let (_, token) = accounts.add_token("anna", "label", Role::Viewer, at(100.0), at(0.0)).expect("added");
    let mut bytes = Vec::new();
    for end in ["", "-wal", "-shm"] {
        let path = format!("{}{end}", accounts.path().display());
        let mode = std::fs::metadata(&path).expect("a file").permissions().mode();
        assert_eq!(mode & 0o777, 0o600, "{path}");
        bytes.extend(std::fs::read(&path).expect("read"));
    }
    let holds = |text: &str| bytes.windows(text.len()).any(|window| window == text.as_bytes());
    assert!(holds("anna") && holds("$argon2id$"), "the search finds what is there");
    for secret in ["a long password", sign_in.reveal(), token.reveal(), &token.reveal()[3..]] {
        assert!(!holds(secret));
    }
    assert!(!format!("{sign_in:?} {:?}", password("a long password")).contains("long"));

    drop(accounts);
    let path = folder.0.join("accounts.db");
    for end in ["-wal", "-shm"] {
        let _ = std::fs::remove_file(format!("{}{end}", path.display()));
    }
    std::fs::write(&path, "this is no database, and long enough to be looked at as one, which it is not")
        .expect("damaged");
    let refused = Accounts::of(&folder.0).expect_err("damaged");
    assert!(refused.to_string().contains("accounts.db"), "{refused}");
}

#[test]
fn the_book_is_read_backwards_page_by_page_and_does_not_grow_for_ever() {
    let folder = Folder::new("book");
    let accounts = Accounts::of(&folder.0).expect("none yet");
    assert_eq!(accounts.changes(None, 10).expect("no file"), []);
    for index in 0..5 {
        let what = format!("change {index}");
        accounts.note(&Change { time: at(f64::from(index)), what, ..Change::default() }).expect("noted");
    }
    let whats = |before, most| {
        let changes = accounts.changes(before, most).expect("asked").into_iter();
        changes.map(|(number, change)| (number, change.what)).collect::<Vec<_>>()
    };
    assert_eq!(whats(None, 2), [(5, "change 4".to_owned()), (4, "change 3".to_owned())]);
    assert_eq!(whats(Some(4), 2), [(3, "change 2".to_owned()), (2, "change 1".to_owned())]);
    assert_eq!(whats(Some(2), 2), [(1, "change 0".to_owned())]);
    let database = database::Database::open(accounts.path()).expect("open");
    database.note(&Change::default(), 3).expect("noted");
    assert_eq!(whats(None, 10).iter().map(|(number, _)| *number).collect::<Vec<_>>(), [6, 5, 4]);
}
