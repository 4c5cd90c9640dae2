//! Finds the paths in Rust source, well enough for code that rustfmt has seen.

/// A path in the code.
#[derive(Clone, Debug, PartialEq)]
pub struct CodePath {
    /// Of its last part, from 1.
    pub line: usize,
    pub parts: Vec<String>,
    /// How many modules of its file it stands in.
    pub inner_modules: usize,
}

#[derive(Clone, Debug, PartialEq)]
enum Token {
    Word(String),
    /// `::`
    Path,
    Sign(char),
}

/// The same text with blanks for comments, strings and characters; lines stay where they are.
pub fn without_comments_and_strings(text: &str) -> String {
    let chars: Vec<char> = text.chars().collect();
    let at = |index: usize| chars.get(index).copied().unwrap_or('\0');
    let mut plain = String::with_capacity(text.len());
    let mut index = 0;
    while index < chars.len() {
        let begins_word = index == 0 || !is_word(at(index - 1));
        let end = match (at(index), at(index + 1)) {
            ('/', '/') => find(&chars, index, |index| at(index) == '\n'),
            ('/', '*') => end_of_comment(&chars, index),
            ('"', _) => end_of_string(&chars, index + 1),
            ('r', '"' | '#') if begins_word => end_of_raw_string(&chars, index + 1).unwrap_or(index),
            ('b', 'r') if begins_word => end_of_raw_string(&chars, index + 2).unwrap_or(index),
            // A character, not a lifetime.
            ('\'', '\\') => find(&chars, index + 3, |index| at(index) == '\'') + 1,
            ('\'', _) if at(index + 2) == '\'' => index + 3,
            _ => index,
        };
        if end == index {
            plain.push(at(index));
            index += 1;
        } else {
            let end = end.min(chars.len());
            plain.extend(chars[index..end].iter().map(|char| if *char == '\n' { '\n' } else { ' ' }));
            index = end;
        }
    }
    plain
}

fn find(chars: &[char], from: usize, found: impl Fn(usize) -> bool) -> usize {
    (from..chars.len()).find(|index| found(*index)).unwrap_or(chars.len())
}

fn end_of_comment(chars: &[char], begin: usize) -> usize {
    let mut depth = 0;
    let mut index = begin;
    while index < chars.len() {
        match (chars[index], chars.get(index + 1)) {
            ('/', Some('*')) => depth += 1,
            ('*', Some('/')) => depth -= 1,
            _ => {
                index += 1;
                continue;
            }
        }
        index += 2;
        if depth == 0 {
            break;
        }
    }
    index
}

fn end_of_string(chars: &[char], mut index: usize) -> usize {
    while index < chars.len() && chars[index] != '"' {
        index += if chars[index] == '\\' { 2 } else { 1 };
    }
    index + 1
}

/// `None` if there is none, such as at `r#type`.
fn end_of_raw_string(chars: &[char], begin: usize) -> Option<usize> {
    let hashes = chars[begin..].iter().take_while(|char| **char == '#').count();
    if chars.get(begin + hashes) != Some(&'"') {
        return None;
    }
    let ends = |index: &usize| {
        chars[*index] == '"'
            && chars[index + 1..].iter().take(hashes).filter(|c| **c == '#').count() == hashes
    };
    (begin + hashes + 1..chars.len()).find(ends).map(|index| index + 1 + hashes)
}

fn is_word(char: char) -> bool {
    char.is_alphanumeric() || char == '_'
}

const TEST_ONLY: &str = "#[cfg(test)]";

/// The modules that `#[cfg(test)] mod name;` says are in a file of their own.
pub fn test_only_modules(plain: &str) -> Vec<String> {
    let declared = plain.match_indices(TEST_ONLY).filter_map(|(place, _)| {
        let mut words = plain[place + TEST_ONLY.len()..].split_whitespace();
        (words.next()? == "mod").then(|| words.next()?.strip_suffix(';').map(str::to_owned))?
    });
    declared.collect()
}

/// The same text with blanks for every item under `#[cfg(test)]`; comments must be gone already.
pub fn without_tests(plain: &str) -> String {
    let mut text = plain.to_owned();
    while let Some(begin) = text.find(TEST_ONLY) {
        let mut depth = 0;
        let mut end = text.len();
        for (place, char) in text[begin + TEST_ONLY.len()..].char_indices() {
            match char {
                '{' => depth += 1,
                '}' => depth -= 1,
                _ => {}
            }
            if depth == 0 && (char == ';' || char == '}') {
                end = begin + TEST_ONLY.len() + place + char.len_utf8();
                break;
            }
        }
        let blank: String = text[begin..end].chars().map(|c| if c == '\n' { '\n' } else { ' ' }).collect();
        text.replace_range(begin..end, &blank);
    }
    text
}

fn tokens(plain: &str) -> Vec<(usize, Token)> {
    let mut tokens = Vec::new();
    for (index, line) in plain.lines().enumerate() {
        let mut chars = line.chars().peekable();
        while let Some(char) = chars.next() {
            let token = if is_word(char) {
                let mut word = String::from(char);
                while let Some(next) = chars.next_if(|next| is_word(*next)) {
                    word.push(next);
                }
                Token::Word(word)
            } else if char == ':' && chars.next_if_eq(&':').is_some() {
                Token::Path
            } else if char.is_whitespace() {
                continue;
            } else {
                Token::Sign(char)
            };
            tokens.push((index + 1, token));
        }
    }
    tokens
}

/// All paths of two parts and more, and each leaf of each `use`.
pub fn code_paths(plain: &str) -> Vec<CodePath> {
    let tokens = tokens(plain);
    let mut paths = Vec::new();
    // For each open brace, whether it is that of a module.
    let mut braces: Vec<bool> = Vec::new();
    let mut index = 0;
    while let Some((_, token)) = tokens.get(index) {
        let before = index.checked_sub(1).map(|before| &tokens[before].1);
        let begins_path = !matches!(before, Some(Token::Path | Token::Sign('.' | '$')));
        match token {
            Token::Sign('{') => {
                let is_module = index >= 2 && tokens[index - 2].1 == Token::Word("mod".to_owned());
                braces.push(is_module);
            }
            Token::Sign('}') => {
                braces.pop();
            }
            Token::Word(word) if word == "use" => {
                let inner_modules = braces.iter().filter(|is_module| **is_module).count();
                index = tree(&tokens, index + 1, &[], inner_modules, &mut paths);
                continue;
            }
            Token::Word(_) if begins_path && is_path(&tokens, index + 1) => {
                let inner_modules = braces.iter().filter(|is_module| **is_module).count();
                index = tree(&tokens, index, &[], inner_modules, &mut paths);
                continue;
            }
            _ => {}
        }
        index += 1;
    }
    paths
}

fn is_path(tokens: &[(usize, Token)], index: usize) -> bool {
    tokens.get(index).is_some_and(|(_, token)| *token == Token::Path)
}

/// Reads `a::b`, `a::{b, c::d}`, `{a, b}` from `index` on; returns the first index after it.
fn tree(
    tokens: &[(usize, Token)],
    mut index: usize,
    stem: &[String],
    inner_modules: usize,
    paths: &mut Vec<CodePath>,
) -> usize {
    let mut parts = stem.to_vec();
    let mut line = tokens.get(index).map_or(0, |(line, _)| *line);
    loop {
        match tokens.get(index) {
            Some((at, Token::Word(word))) => {
                parts.push(word.clone());
                line = *at;
                index += 1;
            }
            // A leading `::`.
            Some((_, Token::Path)) if parts.is_empty() => {}
            Some((_, Token::Sign('{'))) => {
                index += 1;
                while let Some((_, token)) = tokens.get(index) {
                    match token {
                        Token::Sign('}') => return index + 1,
                        Token::Word(_) | Token::Sign('{') => {
                            index = tree(tokens, index, &parts, inner_modules, paths);
                            // Past `as name`.
                            while matches!(tokens.get(index), Some((_, Token::Word(_)))) {
                                index += 1;
                            }
                        }
                        _ => index += 1,
                    }
                }
                return index;
            }
            _ => break,
        }
        if !is_path(tokens, index) {
            break;
        }
        index += 1;
    }
    paths.push(CodePath { line, parts, inner_modules });
    index
}
