# The agent and the emulated controller in one image.
#   docker build -t calibration-agent .
#   docker run --rm -v "$PWD:/work" calibration-agent calibrate recipe.yaml
#   docker compose up     (emulator and agent, for a demonstration)
FROM python:3.12-slim AS build
WORKDIR /source
RUN python -m venv /opt/agent
COPY requirements.lock ./
RUN /opt/agent/bin/pip install --no-cache-dir --requirement requirements.lock
COPY pyproject.toml README.md LICENSE ./
COPY agent agent
COPY drivers drivers
COPY fake_controller fake_controller
COPY second_world second_world
COPY recipes recipes
# Compiled here, because the user of the image cannot write where the functions are kept. Times of files are whole
# seconds: layers keep no fractions, and a source with another time is compiled again.
RUN /opt/agent/bin/pip install --no-cache-dir --no-compile --no-deps . && cd / && \
    find /opt/agent/lib -name '*.py' -exec touch --date="$(date -u +%FT%TZ)" {} + && \
    /opt/agent/bin/python -m compileall -q /opt/agent/lib && \
    /opt/agent/bin/python -c 'from agent.compiled import *'

FROM python:3.12-slim
RUN useradd --create-home --uid 1000 agent && install -d -o agent /work
COPY --from=build /opt/agent /opt/agent
ENV PATH=/opt/agent/bin:$PATH OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1
USER agent
WORKDIR /work
ENTRYPOINT ["agent"]
CMD ["--help"]
