# Trains and tests flowrep on a CPU:
#   docker build -t flowrep .
#   docker run --rm -v "$PWD/outputs:/flowrep/outputs" flowrep train ARGS="seed=1"
#   docker run --rm flowrep test
# It runs as user 1000, who must be able to write to outputs/: chmod o+w outputs
FROM python:3.11-slim-bookworm

# A compiler for torch.compile, make for the two commands; nothing of a screen. Debian's mirrors keep
# the newest versions alone, so that a pinned one is soon gone.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends g++ make \
    && rm -rf /var/lib/apt/lists/*

RUN useradd --create-home --uid 1000 flowrep && install --directory --owner flowrep /flowrep
USER 1000
WORKDIR /flowrep

# .venv first: it is built anew only when what is needed changes.
COPY --chown=flowrep pyproject.toml Makefile README.md LICENSE ./
COPY --chown=flowrep flowrep/__init__.py flowrep/__init__.py
COPY --chown=flowrep conf conf
RUN make develop PYTHON=python3.11 BACKEND=cpu

COPY --chown=flowrep . .
# Copied files are newer than the environment that was made for them.
RUN touch .venv/.installed .venv/.developed

ENTRYPOINT ["make"]
CMD ["train"]
