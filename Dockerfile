# Sorvolo for the processor: docker build -t sorvolo . && docker run --rm -v "$PWD:/data" sorvolo map flight.mp4 --site field
FROM python:3.12-slim AS build
RUN apt-get update && apt-get install -y --no-install-recommends g++ && rm -rf /var/lib/apt/lists/*
WORKDIR /src
COPY pyproject.toml setup.py MANIFEST.in README.md LICENSE NOTICE ./
COPY LICENSES LICENSES
COPY src src
COPY models models
RUN python -m venv /opt/sorvolo \
    && /opt/sorvolo/bin/pip install --no-cache-dir ".[station,postgres]" \
    && cp -r NOTICE LICENSES models/ && mkdir -p models/sorvolo/detection \
    && cp -r src/sorvolo/detection/data models/sorvolo/detection/ \
    && /opt/sorvolo/bin/pip install --no-cache-dir ./models

# rasterio's wheel takes the system's libexpat, which this image lacks
FROM python:3.12-slim
RUN apt-get update && apt-get install -y --no-install-recommends libexpat1 && rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/sorvolo /opt/sorvolo
RUN useradd --create-home --uid 1000 sorvolo && mkdir /data && chown sorvolo /data
USER sorvolo
WORKDIR /data
ENV PATH=/opt/sorvolo/bin:$PATH
ENTRYPOINT ["sorvolo"]
CMD ["--help"]
