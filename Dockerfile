# pansplat on the processor, drawing by Mesa without a display (docs/platforms.md, "Containers").
FROM debian:bookworm-slim

# Python, and GL_PACKAGES of setup.sh
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 python3-venv \
        libegl1 libgl1 libgl1-mesa-dri libgles2 libx11-6 libxcursor1 libxext6 libxi6 libxinerama1 libxkbcommon0 libxrandr2 \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --create-home pansplat \
    && install -d -o pansplat /opt/pansplat /data \
    && install -d -m 1777 /cache

USER pansplat
WORKDIR /opt/pansplat
COPY --chown=pansplat pyproject.toml constraints.txt setup.sh README.md LICENSE ./
COPY --chown=pansplat pansplat pansplat/
COPY --chown=pansplat viewer viewer/
COPY --chown=pansplat shaders shaders/
COPY --chown=pansplat assets/default assets/default/
COPY --chown=pansplat assets/matcher assets/matcher/

# Every user finds the compiled kernels, because numba takes them only from a folder that it can write.
RUN PIP_NO_CACHE_DIR=1 bash setup.sh --cpu && chmod -R a+w pansplat

ENV PATH=/opt/pansplat/.venv/bin:$PATH XDG_CACHE_HOME=/cache
VOLUME /cache
WORKDIR /data
ENTRYPOINT ["pansplat"]
CMD ["--help"]
