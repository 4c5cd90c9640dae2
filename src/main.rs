//! The binary; everything it does is in the library's room `cli`.

fn main() -> std::process::ExitCode {
    holdfast::cli::main()
}
