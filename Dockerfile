FROM debian:13 AS build
COPY . /pharos
RUN apt-get update && /pharos/tools/package deb

FROM debian:13
COPY --from=build /pharos/build/packages/*.deb /tmp/
RUN apt-get update && apt-get install -y --no-install-recommends /tmp/*.deb python3-pil python3-rostopic rosbash
