# The program and the Python package, without a compiler and not as root:
#   docker build -t rowgram . && docker run --rm -v "$PWD/field:/field" rowgram run /field
FROM rust:1-slim-bookworm AS build
RUN apt-get update && apt-get install -y --no-install-recommends gcc libc6-dev python3 python3-venv \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /source
COPY . .
RUN cargo build --release --locked --bin rowgram
RUN python3 -m venv /maturin && /maturin/bin/pip install --no-cache-dir 'maturin>=1.9,<2' \
    && cd python && /maturin/bin/maturin build --release --locked --out /wheels

FROM python:3.12-slim-bookworm
COPY --from=build /source/target/release/rowgram /usr/local/bin/rowgram
COPY --from=build /wheels /wheels
RUN pip install --no-cache-dir /wheels/*.whl && rm -r /wheels && useradd --create-home rowgram
USER rowgram
WORKDIR /home/rowgram
ENTRYPOINT ["rowgram"]
