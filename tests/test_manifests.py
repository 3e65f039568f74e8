"""docker/: what a cluster and compose are told is valid, hangs together, and fits the server."""

from __future__ import annotations

import inspect
import json
import re
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml

from specshield.cli import serve
from specshield.service.leaving import GRACE
from specshield.service.settings import Settings
from tests.test_documented import commands, options

DOCKER = Path(__file__).parent.parent / "docker"
FILES = sorted((DOCKER / "kubernetes").glob("*.yaml"))
KNOWN = {"REDIS_URL", *(f"SPECSHIELD_{name.upper()}" for name in Settings.model_fields)}


def documents(path: Path) -> list[dict[str, Any]]:
    return list(yaml.safe_load_all(path.read_text()))


def everything() -> dict[tuple[str, str], dict[str, Any]]:
    found = [document for path in FILES for document in documents(path)]
    named = {(document["kind"], document["metadata"]["name"]): document for document in found}
    assert len(named) == len(found)
    return named


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_a_manifest_is_valid_by_the_schemas_of_kubernetes(path):
    for document in documents(path):
        kubernetes_validate.validate(document, kubernetes_validate.latest_version(), strict=True)


def test_what_the_manifests_name_is_there():
    named = everything()
    pods = {
        name: document["spec"]["template"]
        for (kind, name), document in named.items()
        if kind in ("Deployment", "StatefulSet")
    }
    for kind, name in named:
        if kind == "Deployment":
            for volume in pods[name]["spec"]["volumes"]:
                claim = volume.get("persistentVolumeClaim", {}).get("claimName")
                assert claim is None or ("PersistentVolumeClaim", claim) in named
            assert named[kind, name]["spec"]["selector"]["matchLabels"].items() <= labels(pods[name]).items()
        if kind == "Service":
            chosen = named[kind, name]["spec"]["selector"].items()
            assert [pod for pod in pods.values() if chosen <= labels(pod).items()], name
    target = named["HorizontalPodAutoscaler", "specshield"]["spec"]["scaleTargetRef"]
    assert (target["kind"], target["name"]) in named
    assert "replicas" not in named["Deployment", "specshield"]["spec"]  # the autoscaler's to say


def test_what_containers_run_and_probe_is_there():
    """Commands with their options, the port that the server listens on, and the addresses of probes."""
    dockerfile = (DOCKER / "Dockerfile").read_text()
    ran = [json.loads(found) for found in re.findall(r"^CMD (\[.*\])$", dockerfile, re.MULTILINE)]
    port = inspect.signature(serve).parameters["port"].default
    assert f"EXPOSE {port}\n" in dockerfile
    asked = re.findall(rf"http://127.0.0.1:{port}(/\w+)", dockerfile)
    for (kind, name), document in everything().items():
        if kind == "Deployment":
            (container,) = document["spec"]["template"]["spec"]["containers"]
            ran.append(container["args"])
            assert [each["containerPort"] for each in container.get("ports", [])] in ([], [port]), name
            asked += [of["httpGet"]["path"] for each, of in container.items() if each.endswith("Probe")]
    assert len(ran) == 4
    for program, name, *words in ran:
        assert program == "specshield"
        assert {word for word in words if word.startswith("-")} <= options(commands()[name])
    assert len(asked) == 3
    assert set(asked) <= json.loads((DOCKER.parent / "openapi.json").read_text())["paths"].keys()


def labels(pod: dict[str, Any]) -> dict[str, str]:
    found: dict[str, str] = pod["metadata"]["labels"]
    return found


def test_a_pod_is_not_killed_before_its_server_has_drained():
    named = everything()
    told = named["ConfigMap", "specshield"]["data"]
    assert told.keys() <= KNOWN
    pod = named["Deployment", "specshield"]["spec"]["template"]["spec"]
    waits = pod["containers"][0]["lifecycle"]["preStop"]["sleep"]["seconds"]
    assert pod["terminationGracePeriodSeconds"] > waits + float(told["SPECSHIELD_DRAIN"]) + GRACE


def test_compose_tells_servers_nothing_that_is_not_a_setting_and_gives_them_time_to_drain():
    services = yaml.safe_load((DOCKER / "compose.yaml").read_text())["services"]
    assert {"redis", "server", "worker"} <= services.keys()
    for name in ("server", "worker"):
        assert services[name]["environment"].keys() <= KNOWN
        wait = float(services[name]["stop_grace_period"].removesuffix("s"))
        assert wait > float(services[name]["environment"]["SPECSHIELD_DRAIN"]) + GRACE


def test_docker_is_given_what_the_image_is_built_of():
    """.dockerignore leaves everything out that it does not name."""
    let_in = {line[1:] for line in (DOCKER.parent / ".dockerignore").read_text().split() if line[0] == "!"}
    lines = (DOCKER / "Dockerfile").read_text().splitlines()
    copied = {name for line in lines if re.match(r"COPY (?!--from)", line) for name in line.split()[1:-1]}
    assert {"app", "LICENSE"} <= copied <= let_in
    assert all((DOCKER.parent / name).exists() for name in copied)
