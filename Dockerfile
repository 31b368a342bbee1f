# The demo in a container. Its page and pictures are written into the folder that is mounted at /demo:
#   docker build -t rimlight .
#   docker run --rm -v "$PWD/demo:/demo" rimlight
# Other commands follow the name of the image:
#   docker run --rm rimlight sys-info
FROM python:3.12-slim
# LLVM needs it
RUN apt-get update && apt-get install -y --no-install-recommends libatomic1 && rm -rf /var/lib/apt/lists/*
COPY . /source
RUN pip install --no-cache-dir /source && rm -rf /source
WORKDIR /
ENTRYPOINT ["rimlight"]
CMD ["demo", "--out", "/demo"]
