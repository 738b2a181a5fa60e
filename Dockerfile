# RoboXim's wheels on Debian's Python: docker build --tag roboxim . && docker run --rm roboxim demo --smoke
# hadolint global ignore=DL3008
# DL3008 asks for pinned versions of Debian's packages, which Debian deletes with its next update.
FROM python:3.12-slim-bookworm AS build
RUN apt-get update \
    && apt-get install -y --no-install-recommends build-essential git make \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /src
COPY . .
RUN make setup PYTHON=python3.12 \
    && .venv/bin/python scripts/make_environment.py release \
    && .venv/bin/python scripts/release.py --python 3.12 --no-try

FROM python:3.12-slim-bookworm
RUN apt-get update \
    && apt-get install -y --no-install-recommends libegl1 libgl1-mesa-dri \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --create-home --uid 1000 roboxim
RUN --mount=type=bind,from=build,source=/src/dist,target=/dist \
    pip install --no-cache-dir --find-links /dist --constraint /dist/constraints.txt "roboxim[assets,learn,lerobot,studio,vla-eval]"
USER 1000
WORKDIR /home/roboxim
ENTRYPOINT ["roboxim"]
CMD ["--help"]
