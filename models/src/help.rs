//! The examples of a help text, as what a shell would make of them: tests hold every one of them against the command line and the
//! files that there are.

/// The examples of `program` in a help text, each as its words; a line that ends in a backslash goes on in the next one. What stands
/// behind two spaces and a bracket is a remark.
#[must_use]
pub fn examples(text: &str, program: &str) -> Vec<Vec<String>> {
    let joined = text.replace("\\\n", " ");
    let commands = joined.lines().map(str::trim).filter(|line| line.split(' ').next() == Some(program));
    commands.map(|line| words(line.split("  (").next().unwrap_or(line))).collect()
}

/// The documents of the project, whose commands are examples, too: every Markdown file at the root, in `docs` and in `benches`.
fn documents(root: &std::path::Path) -> std::io::Result<Vec<String>> {
    let mut texts = Vec::new();
    for folder in [root.to_path_buf(), root.join("docs"), root.join("benches")] {
        for entry in std::fs::read_dir(folder)? {
            let path = entry?.path();
            if path.extension().is_some_and(|ending| ending == "md") {
                texts.push(std::fs::read_to_string(path)?);
            }
        }
    }
    Ok(texts)
}

/// Words as a shell splits them: by spaces outside of double quotes; a `&` at the end is none, nor is a remark behind ` #`.
fn words(line: &str) -> Vec<String> {
    let (mut words, mut word, mut quoted) = (Vec::new(), String::new(), false);
    for letter in line.chars() {
        match letter {
            '"' => quoted = !quoted,
            ' ' if !quoted => words.push(std::mem::take(&mut word)),
            '#' if !quoted && word.is_empty() => break,
            letter => word.push(letter),
        }
    }
    words.push(word);
    words.retain(|word| !word.is_empty() && word != "&");
    words
}

/// What is wrong with the examples of `program` in help texts and in the documents of the project at `root`: those that `parse` refuses, and those that name a shipped file that is not
/// there below `root`. Also how many there are.
///
/// # Errors
/// The first example that is wrong, and why.
pub fn check_examples(
    texts: &[String],
    program: &str,
    root: &std::path::Path,
    parse: impl Fn(&[String]) -> Result<(), String>,
) -> Result<usize, String> {
    let documents = documents(root).map_err(|error| format!("documents: {error}"))?;
    let all: Vec<_> = texts.iter().chain(&documents).flat_map(|text| examples(text, program)).collect();
    for example in &all {
        parse(example).map_err(|reason| format!("{example:?}: {reason}"))?;
        if let Some(missing) = missing_file(example, root) {
            return Err(format!("{example:?}: {missing} is not shipped"));
        }
    }
    Ok(all.len())
}

/// The first path of an example that is said to be shipped, under `models/` or `tests/`, and is not there below `root`.
fn missing_file(example: &[String], root: &std::path::Path) -> Option<String> {
    let shipped = |word: &&String| word.starts_with("models/") || word.starts_with("tests/");
    let made = |index: usize| index > 0 && example[index - 1] == "--out";
    let paths = example.iter().enumerate().filter(|(index, word)| shipped(word) && !made(*index));
    paths.map(|(_, word)| word).find(|word| !root.join(word).exists()).cloned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn examples_are_what_a_shell_would_run() {
        let text = "Examples:\n  tool go --a 1 \\\n      --b \"x y=z\" &\n  other go\n  tool stop        (when it is enough)\n\nMore.";
        let expected = [vec!["tool", "go", "--a", "1", "--b", "x y=z"], vec!["tool", "stop"]];
        assert_eq!(examples(text, "tool"), expected);
    }

    #[test]
    fn remarks_are_no_words() {
        assert_eq!(words("tool run --a b#c &    # beside `x`"), ["tool", "run", "--a", "b#c"]);
    }

    #[test]
    fn an_example_that_is_refused_or_names_what_is_not_there_is_told() {
        let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
        let check = |line: &str| {
            let refuse = |example: &[String]| {
                if example.contains(&"bad".to_owned()) { Err("bad".to_owned()) } else { Ok(()) }
            };
            check_examples(&[format!("Examples:\n  {line}\n")], "tool", &root, refuse)
        };
        assert_eq!(check("tool --bundle models/small"), Ok(1));
        assert!(check("tool bad").unwrap_err().contains("bad"));
        assert!(check("tool --bundle models/nothing").unwrap_err().contains("models/nothing is not shipped"));
    }

    #[test]
    fn a_path_that_is_said_to_be_shipped_must_be_there() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("models")).unwrap();
        let missing = |line: &str| missing_file(&words(line), folder.path());
        assert_eq!(missing("tool --bundle models/debug"), Some("models/debug".to_owned()));
        assert_eq!(missing("tool --bundle runs/mine --out models/new models/"), None);
    }
}
