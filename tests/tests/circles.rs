//! No file and no folder imports what imports it (ARCHITECTURE.md, invariants). A module and those inside it count as one house: a
//! `mod.rs` may use its parts, and they may use what it holds. A name that it re-exports counts as where it comes from.

#![allow(clippy::unwrap_used, reason = "a test that fails panics")]

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use rcwm_tests::root;
use syn::visit::{Visit, visit_item_mod, visit_path};

/// Folders of source whose files make up one crate.
const CRATES: &[&str] = &[
    "models/src",
    "runtime/src",
    "runtime/kernels/src",
    "runtime/lab/src",
    "runtime/python/native",
    "runtime/capi/src",
    "trainer/src",
    "trainer/gpu/src",
    "trainer/simulator/src",
    "tests/src",
    "tests/src/bin/hostile-peer",
    "tests/src/bin/mutated-bundles",
    "benches/src/training_update",
];

type Module = Vec<String>;
type Graph = BTreeMap<Module, BTreeSet<Module>>;

/// Every file of Rust below a folder, by the module it holds; folders of programs of their own are not looked into.
fn modules(folder: &Path, at: &[String], found: &mut BTreeMap<Module, PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_stem().unwrap().to_str().unwrap().to_owned();
        let inside = [at, std::slice::from_ref(&name)].concat();
        if path.is_dir() && !path.join("main.rs").exists() && name != "bin" {
            modules(&path, &inside, found);
        } else if path.extension().is_some_and(|extension| extension == "rs") && name != "main" {
            let is_folder = matches!(name.as_str(), "mod" | "lib");
            found.insert(if is_folder { at.to_vec() } else { inside }, path);
        }
    }
}

/// The paths that a file names, but for its tests: `crate::a::B` as `[crate, a, B]`; and those whose names it re-exports.
#[derive(Default)]
struct Named(Vec<Vec<String>>, Vec<Vec<String>>);

/// Where a module's re-exported names come from, as it writes it.
type Reexports = BTreeMap<(Module, String), Vec<String>>;

impl Named {
    fn add_tree(&mut self, before: &[String], tree: &syn::UseTree) {
        let with = |name: &syn::Ident| [before, &[name.to_string()]].concat();
        match tree {
            syn::UseTree::Path(path) => self.add_tree(&with(&path.ident), &path.tree),
            syn::UseTree::Group(group) => group.items.iter().for_each(|item| self.add_tree(before, item)),
            syn::UseTree::Name(name) => self.0.push(with(&name.ident)),
            syn::UseTree::Rename(name) => self.0.push(with(&name.ident)),
            syn::UseTree::Glob(_) => self.0.push(before.to_vec()),
        }
    }
}

impl<'ast> Visit<'ast> for Named {
    fn visit_item_mod(&mut self, module: &'ast syn::ItemMod) {
        let is_test = |attribute: &syn::Attribute| attribute.path().is_ident("cfg");
        if !module.attrs.iter().any(is_test) {
            visit_item_mod(self, module);
        }
    }

    fn visit_item_use(&mut self, item: &'ast syn::ItemUse) {
        let before = self.0.len();
        self.add_tree(&[], &item.tree);
        if !matches!(item.vis, syn::Visibility::Inherited) {
            self.1.extend_from_slice(&self.0[before..]);
        }
    }

    fn visit_path(&mut self, path: &'ast syn::Path) {
        self.0.push(path.segments.iter().map(|segment| segment.ident.to_string()).collect());
        visit_path(self, path);
    }
}

/// The module of this crate that a path inside `from` leads to, through re-exports.
fn resolve(
    path: &[String],
    from: &[String],
    all: &BTreeMap<Module, PathBuf>,
    reexports: &Reexports,
) -> Option<Module> {
    let supers = path.iter().take_while(|part| *part == "super").count();
    let full: Module = match path.first()?.as_str() {
        "crate" => path[1..].to_vec(),
        "self" => [from, &path[1..]].concat(),
        "super" => [from.get(..from.len().checked_sub(supers)?)?, &path[supers..]].concat(),
        // A path of a `mod.rs` may begin with one of its own files.
        own if all.contains_key(&[from, &[own.to_owned()]].concat()) => [from, path].concat(),
        _ => return None,
    };
    let mut target = full.clone();
    while !all.contains_key(&target) {
        target.pop()?;
    }
    let source = full.get(target.len()).and_then(|name| reexports.get(&(target.clone(), name.clone())));
    match source {
        Some(source) if *source != path => resolve(source, &target, all, reexports).or(Some(target)),
        _ => Some(target),
    }
}

fn imports(folder: &Path) -> Graph {
    let mut all = BTreeMap::new();
    modules(folder, &[], &mut all);
    let read = |path: &PathBuf| {
        let mut named = Named::default();
        named.visit_file(&syn::parse_file(&fs::read_to_string(path).unwrap()).unwrap());
        named
    };
    let named: BTreeMap<_, _> = all.iter().map(|(module, path)| (module, read(path))).collect();
    let of = |(module, named): (&&Module, &Named)| {
        let name = |path: &Vec<String>| Some(((*module).clone(), path.last()?.clone()));
        named.1.iter().filter_map(|path| Some((name(path)?, path.clone()))).collect::<Vec<_>>()
    };
    let reexports: Reexports = named.iter().flat_map(of).collect();
    let of = |(module, named): (&Module, Named)| {
        let targets = named.0.iter().filter_map(|path| resolve(path, module, &all, &reexports));
        let others = targets.filter(|target| !target.starts_with(module) && !module.starts_with(target));
        (module.clone(), others.collect())
    };
    named.into_iter().map(of).collect()
}

/// The same between the folders and files right in the crate.
fn folders(graph: &Graph) -> Graph {
    let mut between = Graph::new();
    for (from, targets) in graph {
        let (Some(from), targets) = (from.first(), targets.iter().filter_map(|target| target.first())) else {
            continue;
        };
        let others = targets.filter(|target| *target != from).map(|target| vec![target.clone()]);
        between.entry(vec![from.clone()]).or_default().extend(others);
    }
    between
}

/// What is in a circle, or leads into one: all that is left when whatever imports nothing is taken away, again and again.
fn circles(mut graph: Graph) -> Graph {
    loop {
        let before = graph.len();
        let left: BTreeSet<Module> = graph.keys().cloned().collect();
        graph.values_mut().for_each(|targets| targets.retain(|target| left.contains(target)));
        graph.retain(|_, targets| !targets.is_empty());
        if graph.len() == before {
            return graph;
        }
    }
}

#[test]
fn no_file_and_no_folder_imports_what_imports_it() {
    let mut count = 0;
    for folder in CRATES {
        let graph = imports(&root().join(folder));
        assert!(graph.len() > 1, "{folder} was read");
        count += graph.values().map(BTreeSet::len).sum::<usize>();
        assert_eq!(circles(folders(&graph)), Graph::new(), "{folder}: folders import each other");
        assert_eq!(circles(graph), Graph::new(), "{folder}: files import each other");
    }
    assert!(count > 300, "only {count} imports were found");
}

#[test]
fn what_a_file_names_is_found_but_for_its_tests() {
    let text = "use super::b::{self, c::D}; fn f() { crate::e::g(); }
                #[cfg(test)] mod tests { use crate::only::here; }";
    let mut named = Named::default();
    named.visit_file(&syn::parse_file(text).unwrap());
    let module = |path: &str| path.split("::").map(str::to_owned).collect::<Module>();
    let all = ["a", "b", "b::c", "e", "only"].map(|path| (module(path), PathBuf::new())).into();
    let hidden = Reexports::from([((module("e"), "g".to_owned()), module("super::b::c::G"))]);
    let leads = |reexports: &Reexports| -> BTreeSet<_> {
        named.0.iter().filter_map(|path| resolve(path, &module("a"), &all, reexports)).collect()
    };
    assert_eq!(leads(&Reexports::new()), [module("b"), module("b::c"), module("e")].into());
    assert_eq!(leads(&hidden), [module("b"), module("b::c")].into(), "a re-exported name is followed");
}

#[test]
fn a_circle_is_found() {
    let module = |name: &str| vec![name.to_owned()];
    let edge = |from: &str, to: &[&str]| (module(from), to.iter().map(|to| module(to)).collect());
    let graph = Graph::from([edge("a", &["b"]), edge("b", &["c"]), edge("c", &["b"]), edge("d", &[])]);
    assert!(circles(graph.clone()).contains_key(&module("b")));
    let without = graph.into_iter().filter(|(name, _)| *name != module("c")).collect();
    assert_eq!(circles(without), Graph::new());
}
