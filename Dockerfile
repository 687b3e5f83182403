# The agent and the emulated controller in one image.
#   docker build -t calibration-agent .
#   docker run --rm -v "$PWD:/work" calibration-agent calibrate recipe.yaml
#   docker run --rm --network host --entrypoint python calibration-agent -m fake_controller --robot comau_ns16 --port 9100
FROM python:3.12-slim
WORKDIR /opt/calibration-agent
COPY requirements.lock pyproject.toml README.md LICENSE ./
RUN pip install --no-cache-dir -r requirements.lock
COPY agent agent
COPY drivers drivers
COPY fake_controller fake_controller
COPY second_world second_world
RUN pip install --no-cache-dir --no-deps . && cd / && python -c 'from agent.compiled import *'
WORKDIR /work
ENV OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1
ENTRYPOINT ["agent"]
CMD ["--help"]
