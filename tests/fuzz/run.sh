#!/usr/bin/env bash
# Feeds damaged files to every reader, with libFuzzer and the address sanitizer.
#
#   tests/fuzz/run.sh            30 seconds for each reader
#   tests/fuzz/run.sh 600 bal    ten minutes for one
#
# Needs a nightly compiler and cargo-fuzz; says so and ends with 77 where one is missing. What is found lies in
# tests/fuzz/artifacts, and `cargo fuzz run` with that file repeats it. Seeds are in tests/fuzz/corpus; what grows
# from them is kept in target. Commands as a whole are in commands.sh, which needs neither.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."

skip() {
    printf 'fuzz: skipped, %s\n' "$*" >&2
    exit 77
}
rustup toolchain list 2>/dev/null | grep -q '^nightly' || skip 'no nightly compiler: rustup toolchain install nightly'
command -v cargo-fuzz >/dev/null || skip 'no cargo-fuzz: cargo install cargo-fuzz'

seconds=${1:-30}
shift || true
targets=("$@")
[[ ${#targets[@]} -gt 0 ]] || mapfile -t targets < <(cargo +nightly fuzz list --fuzz-dir tests/fuzz)
for target in "${targets[@]}"; do
    grown=target/fuzz-corpus/$target
    mkdir -p "$grown"
    seeds=()
    [[ ! -d tests/fuzz/corpus/$target ]] || seeds=("tests/fuzz/corpus/$target")
    [[ $target != geotiff && $target != exif ]] || seeds+=("tests/golden/geotiff")
    printf '== %s\n' "$target"
    cargo +nightly fuzz run --fuzz-dir tests/fuzz --target-dir target/fuzz "$target" "$grown" "${seeds[@]}" -- \
        -max_total_time="$seconds" -rss_limit_mb=4096 -malloc_limit_mb=4096 -timeout=20 -print_final_stats=1
done
