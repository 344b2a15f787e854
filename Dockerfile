# lio_jax on a CPU:  docker build -t lio-jax .  and  docker run --rm -v "$PWD":/data lio-jax run my.bag --out out/my
FROM python:3.11-slim

# any user may write here: results belong to the caller with --user "$(id -u):$(id -g)"
ENV HOME=/home/lio
RUN useradd --uid 1000 --create-home lio && mkdir -p /home/lio/.cache && chmod -R a+rwX /home/lio

WORKDIR /opt/lio_jax
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY lio_jax lio_jax
RUN pip install --no-cache-dir --disable-pip-version-check --constraint constraints.txt .

USER lio
WORKDIR /data
ENTRYPOINT ["lio-jax"]
CMD ["--help"]
