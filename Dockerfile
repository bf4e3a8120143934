# fullswarm as a container: docs/how-to-install.md has the command lines.
#   docker build -t fullswarm .                             simulation, console, experiments
#   docker build -t fullswarm --build-arg EXTRAS=all .      everything
ARG PYTHON=3

# The full image has a compiler, for dependencies that have no wheel for this Python.
FROM python:${PYTHON} AS build
ARG EXTRAS=core,sim,experiments,console,record
COPY pyproject.toml README.md LICENSE /source/
COPY fullswarm /source/fullswarm
RUN python -m venv /opt/fullswarm && /opt/fullswarm/bin/pip install --no-cache-dir "/source[${EXTRAS}]"

FROM python:${PYTHON}-slim
COPY --from=build /opt/fullswarm /opt/fullswarm
RUN useradd --create-home --uid 1000 swarm
ENV PATH=/opt/fullswarm/bin:$PATH
USER swarm
WORKDIR /home/swarm
# The console's page; the hub.
EXPOSE 8807 7447
ENTRYPOINT ["fullswarm"]
CMD ["--help"]
