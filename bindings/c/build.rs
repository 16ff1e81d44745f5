//! The name under which programs find the shared library.

fn main() {
    // The number changes when a program that was compiled before no longer works.
    println!("cargo:rustc-cdylib-link-arg=-Wl,-soname,libfipa.so.0");
    println!("cargo:rerun-if-changed=build.rs");
}
