# docker build -t sagesplat .                        CPU; about 2 GB
# docker build -t sagesplat:cuda --target cuda .     for NVIDIA GPUs; run it with --gpus all
#
# docker run --rm -v "$PWD:/work" sagesplat demo
# docker run --rm -v "$PWD:/work" -p 127.0.0.1:8000:8000 sagesplat view runs/demo --host 0.0.0.0 --port 8000 --no-browser

FROM python:3.12-slim AS wheel
WORKDIR /source
COPY . .
RUN pip install --no-cache-dir --constraint constraints.txt hatchling \
 && python -m hatchling build --target wheel --directory /wheel

# Not run on a GPU yet. The -devel image has nvcc, with which gsplat compiles its kernels at their first use.
FROM nvidia/cuda:13.0.2-devel-ubuntu24.04 AS cuda
RUN apt-get update \
 && apt-get install --yes --no-install-recommends python3 python3-dev python3-venv g++ ninja-build libgl1 \
 && rm -rf /var/lib/apt/lists/* \
 && python3 -m venv /opt/sagesplat
ENV PATH=/opt/sagesplat/bin:$PATH
COPY --from=wheel /wheel /wheel
COPY constraints.txt /wheel/
RUN pip install --no-cache-dir --constraint /wheel/constraints.txt \
    "$(echo /wheel/*.whl)[poses,hf,view,video,heic,cuda]"
WORKDIR /work
ENTRYPOINT ["sagesplat"]
CMD ["--help"]

FROM python:3.12-slim AS cpu
RUN apt-get update && apt-get install --yes --no-install-recommends libgl1 libglib2.0-0 \
 && rm -rf /var/lib/apt/lists/*
COPY --from=wheel /wheel /wheel
COPY constraints.txt /wheel/
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
RUN pip install --no-cache-dir --extra-index-url "$TORCH_INDEX" --constraint /wheel/constraints.txt \
    "$(echo /wheel/*.whl)[poses,hf,onnx,view,video,heic]"
WORKDIR /work
ENTRYPOINT ["sagesplat"]
CMD ["--help"]
