# slam with all inputs and outputs, for the folder that is mounted at /data:
#   docker build -t slamcli .
#   docker run --rm -v "$PWD:/data" --user "$(id -u):$(id -g)" slamcli stitch frames -o map
FROM python:3.13-slim AS build
WORKDIR /source
COPY pyproject.toml README.md LICENSE ./
COPY slamcli slamcli
RUN python -m venv /venv \
    && /venv/bin/pip install --no-cache-dir ".[geo,geotiff,heic,pages,rosbag,video]"

FROM python:3.13-slim
COPY --from=build /venv /venv
ENV PATH="/venv/bin:$PATH" PYTHONDONTWRITEBYTECODE=1
# A server of `slam view` is reached from outside only with --network host.
RUN useradd --create-home slam
USER slam
WORKDIR /data
ENTRYPOINT ["slam"]
CMD ["--help"]
