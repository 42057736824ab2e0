# docker build -t hydrotele . && docker run --rm -v "$PWD/demo:/hydrotele/demo" hydrotele
FROM python:3.12-slim-bookworm
RUN apt-get update && apt-get install -y --no-install-recommends \
    libegl1 libgl1 libgl1-mesa-dri libgomp1 git && rm -rf /var/lib/apt/lists/*
WORKDIR /hydrotele
COPY . .
RUN bash tools/setup
CMD ["bash", "tools/demo"]
