#!/usr/bin/env bash
# Feeds damaged files and odd options to every command, with a limit of memory and of time.
#
#   tests/fuzz/commands.sh            ten minutes
#   tests/fuzz/commands.sh 3600 7     an hour of other cases
#
# The files are made first, by the program itself and by the test (tests/mutations.rs). What is found lies in
# target/fuzz-found, a folder for each case.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
FUZZ_SECONDS=${1:-600} FUZZ_SEED=${2:-1} cargo test --workspace --locked --test it mutations -- --ignored --nocapture
