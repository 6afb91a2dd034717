"""The manifest for Kubernetes is valid and consistent with the service."""

import re
from typing import Any

import pytest
import yaml

from msdgs_serve.api.metrics import Metrics
from msdgs_serve.api.settings import Settings
from msdgs_serve.api.work import WorkQueue
from msdgs_serve.renderer import Renderer
from msdgs_serve.store import SceneStore
from tests.support.processes import ROOT

FOLDER = ROOT / "docker" / "kubernetes"
KUBERNETES = "1.30"
OBJECTS: list[dict[str, Any]] = list(yaml.safe_load_all((FOLDER / "msdgs.yaml").read_text()))


def found(kind: str, name: str) -> dict[str, Any]:
    (match,) = [each for each in OBJECTS if (each["kind"], each["metadata"]["name"]) == (kind, name)]
    return match


def container(name: str) -> dict[str, Any]:
    (only,) = found("Deployment", name)["spec"]["template"]["spec"]["containers"]
    return only


@pytest.mark.slow
@pytest.mark.parametrize("manifest", OBJECTS, ids=lambda each: f"{each['kind']}-{each['metadata']['name']}")
def test_it_is_valid(manifest: dict[str, Any]):
    validate = pytest.importorskip("kubernetes_validate", reason="kubernetes-validate isn't installed").validate
    assert validate(manifest, KUBERNETES, strict=True) == KUBERNETES


@pytest.mark.parametrize("name", ["msdgs-render", "msdgs-proxy"])
def test_pods_have_probes_limits_and_few_rights(name: str):
    pod, only = found("Deployment", name)["spec"]["template"]["spec"], container(name)
    assert {"readinessProbe", "livenessProbe"} <= only.keys()
    assert {"cpu", "memory"} == only["resources"]["requests"].keys() == only["resources"]["limits"].keys()
    assert pod["securityContext"]["runAsNonRoot"]
    assert pod["enableServiceLinks"] is False, "or MSDGS_PORT is the address of the Service msdgs"
    assert only["securityContext"]["readOnlyRootFilesystem"]
    assert only["securityContext"]["capabilities"] == {"drop": ["ALL"]}


@pytest.mark.parametrize("name", ["msdgs-render", "msdgs-proxy"])
def test_selectors_find_their_pods(name: str):
    deployment = found("Deployment", name)
    labels = deployment["spec"]["template"]["metadata"]["labels"]
    assert deployment["spec"]["selector"]["matchLabels"] == labels
    assert found("Service", "msdgs" if name == "msdgs-proxy" else name)["spec"]["selector"] == labels


def test_the_services_settings_are_known():
    render = container("msdgs-render")
    names = {each["name"] for each in render["env"]}
    assert names <= {f"MSDGS_{field.upper()}" for field in Settings.model_fields}
    assert {each["name"]: each for each in render["env"]}["MSDGS_THREADS"]["value"] == render["resources"]["limits"][
        "cpu"
    ]
    grace = found("Deployment", "msdgs-render")["spec"]["template"]["spec"]["terminationGracePeriodSeconds"]
    assert grace > Settings.model_fields["drain_seconds"].default
    assert render["startupProbe"]["httpGet"]["path"] == render["readinessProbe"]["httpGet"]["path"] == "/ready"
    assert render["livenessProbe"]["httpGet"]["path"] == "/live"


def test_only_the_proxy_and_prometheus_reach_replicas():
    """As they believe what `X-Forwarded-For` says."""
    rules, pods = found("NetworkPolicy", "msdgs-render")["spec"], found("Deployment", "msdgs-render")["spec"]
    assert rules["podSelector"] == pods["selector"]
    assert rules["policyTypes"] == ["Ingress"]
    (rule,) = rules["ingress"]
    proxy, prometheus = rule["from"]
    assert proxy["podSelector"] == found("Deployment", "msdgs-proxy")["spec"]["selector"]
    assert prometheus["podSelector"] == {"matchLabels": {"app.kubernetes.io/name": "prometheus"}}
    (port,) = rule["ports"]
    assert port["port"] in {each["name"] for each in container("msdgs-render")["ports"]}


def test_the_autoscaler_reads_a_metric_of_the_service():
    (metric,) = found("HorizontalPodAutoscaler", "msdgs-render")["spec"]["metrics"]
    name = metric["pods"]["metric"]["name"]
    page = Metrics(SceneStore([]), Renderer(0), WorkQueue(1, 1, 1.0)).page().decode()
    assert f"\n{name} " in page
    (rule,) = yaml.safe_load((FOLDER / "prometheus-adapter.yaml").read_text())["rules"]["custom"]
    assert rule["name"]["matches"] == name
    assert rule["seriesQuery"].startswith(f"{name}{{")
    assert int(metric["pods"]["target"]["averageValue"]) < Settings.model_fields["queued_renders"].default


def test_the_proxy_finds_its_settings():
    name = "msdgs-proxy"
    (settings, _) = found("Deployment", name)["spec"]["template"]["spec"]["volumes"]
    assert [source["configMap"]["name"] for source in settings["projected"]["sources"]] == [
        "msdgs-nginx",
        found("ConfigMap", "msdgs-replicas")["metadata"]["name"],
    ]
    nginx, lists = ROOT / "docker" / "nginx", found("ConfigMap", "msdgs-replicas")["data"]
    included = re.findall(r"include (\S+);", (nginx / "nginx.conf").read_text())
    assert sorted(included) == sorted(lists)
    host = f"{found('Service', 'msdgs-render')['metadata']['name']}.default.svc.cluster.local"
    for name in included:
        (server,) = re.findall(r"^server .*", (nginx / name).read_text(), re.MULTILINE)
        assert server.replace("render:", f"{host}:") in lists[name], "the same server with the same parameters"
