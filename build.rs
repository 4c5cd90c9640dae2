//! Makes the folder from which the page is embedded.

fn main() {
    let out = std::env::var_os("OUT_DIR").expect("cargo sets it");
    std::fs::create_dir_all(std::path::Path::new(&out).join("web")).expect("the folder can be made");
    println!("cargo::rerun-if-changed=build.rs");
}
