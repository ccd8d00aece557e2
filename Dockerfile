# The package on a CPU; without a command it runs the demo into /data/demo:
#   docker build -t gnss-sem-map . && docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" gnss-sem-map
# Without --user, results belong to root.
# --build-arg EXTRAS='[segmentation]' adds torch; --build-arg PIP_EXTRA_INDEX_URL=... names the index of its CPU builds, which pip then prefers.
FROM python:3.11-slim
# --build-arg VERSION=1.2.3 names the version, which is otherwise the fallback: .git is not copied.
ARG EXTRAS=""
ARG PIP_EXTRA_INDEX_URL
ARG VERSION=""
# GDAL in the wheel of rasterio needs it, and slim images may lack it
RUN apt-get update && apt-get install --yes --no-install-recommends libexpat1 && rm -rf /var/lib/apt/lists/*
WORKDIR /src
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY gnss_sem_map gnss_sem_map
COPY factor_graphs factor_graphs
RUN SETUPTOOLS_SCM_PRETEND_VERSION_FOR_GNSS_SEM_MAP="${VERSION}" \
    pip install --no-cache-dir -c constraints.txt ".${EXTRAS}"
# Kernels are compiled for the CPU of this machine; without, or on another CPU, every container does so itself, for half a minute
RUN python -m gnss_sem_map.cli.compile_ahead
WORKDIR /data
ENTRYPOINT ["gnss-sem-map"]
CMD ["demo"]
