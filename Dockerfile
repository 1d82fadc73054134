# Everything, on the CPU: docker build -t partialbench . && docker run --rm partialbench doctor
# With a GPU: docker run --gpus all -e NVIDIA_DRIVER_CAPABILITIES=graphics,compute,utility …
FROM python:3.11-slim

# make; the libraries that Mitsuba's LLVM variant and Open3D
# load are installed by the project's own script, as on any other machine.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends make \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /opt/partialbench
COPY . .
# The same command as in the README; then proof that what was installed works.
RUN make setup && .venv/bin/partialbench doctor

WORKDIR /data
ENV PATH="/opt/partialbench/.venv/bin:${PATH}"
ENTRYPOINT ["partialbench"]
CMD ["--help"]
