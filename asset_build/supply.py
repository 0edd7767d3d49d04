"""What an installation consists of: `python asset_build/supply.py sbom`, `licences` or `check`.

All of it comes from the metadata of the installed packages, without a network. `sbom` prints a software bill of
materials as CycloneDX 1.6 JSON, the same bytes for the same installation, with the libraries that wheels bundle.
`licences` prints the table of docs/security.md. `check` compares versions with known_vulnerabilities.json beside this
file and fails where one is affected that nobody has accepted with a reason; that list is written from memory, of no
database, and does not replace `pip-audit`.
"""

import base64
import json
import re
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

ROOT = "oasis-warp"
KNOWN = Path(__file__).with_name("known_vulnerabilities.json")
LIBRARY = re.compile(r"\.libs/(?P<name>lib[^/]*?)(?:-[0-9a-f]{8})*\.so\.(?P<version>[^/]+)$")
"""A shared library that a repaired wheel bundles: libcrypto-5409cd36.so.1.1.1k."""
WORDS = {
    "MIT License": "MIT", "BSD License": "BSD-3-Clause", "Apache Software License": "Apache-2.0",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
}  # fmt: skip
"""Classifiers of licences and their SPDX names."""


def canonical(name: str) -> str:
    """The name of a package as registries write it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def installed() -> dict[str, metadata.Distribution]:
    """This package and all that it needs to run here, by name."""
    found: dict[str, metadata.Distribution] = {}
    waiting = [ROOT]
    while waiting:
        name = canonical(waiting.pop())
        if name not in found:
            found[name] = metadata.distribution(name)
            needed = map(Requirement, found[name].requires or ())
            waiting += [each.name for each in needed if each.marker is None or each.marker.evaluate({"extra": ""})]
    return dict(sorted(found.items()))


def licence(package: metadata.Distribution) -> str:
    """The licence that a package states: an SPDX expression where it has one.

    Raises:
        ValueError: it states none.
    """
    about = package.metadata
    if expression := about.get("License-Expression"):
        return expression
    classifiers = [line.split(" :: ")[-1] for line in about.get_all("Classifier") or () if line.startswith("License")]
    stated = [WORDS.get(name, name) for name in classifiers] or [about.get("License", "").strip()]
    if not stated[0] or "\n" in stated[0]:
        raise ValueError(f"{about['Name']}: expected a licence in its metadata, found none.")
    return " AND ".join(sorted(set(stated)))


def bundled(package: metadata.Distribution) -> Iterator[dict[str, Any]]:
    """Shared libraries that a package's wheel carries, as components."""
    for file in sorted(package.files or (), key=str):
        if match := LIBRARY.search(file.as_posix()):
            value = base64.urlsafe_b64decode(file.hash.value + "==").hex() if file.hash else None
            hashes = [{"alg": "SHA-256", "content": value}] if value else []
            yield {"type": "library", "name": match["name"], "version": match["version"], "hashes": hashes}


def bill_of_materials() -> dict[str, Any]:
    """CycloneDX 1.6 without a time or a serial number, which are optional."""
    packages, components = installed(), []
    for name, package in packages.items():
        component = {
            "type": "library", "bom-ref": f"pkg:pypi/{name}@{package.version}", "name": name,
            "version": package.version, "purl": f"pkg:pypi/{name}@{package.version}",
            "licenses": [{"license": {"name": licence(package)}}],
        }  # fmt: skip
        if parts := list(bundled(package)):
            component["components"] = parts
        components.append(component)
    refs = {component["name"]: component["bom-ref"] for component in components}
    needs = []
    for name, package in packages.items():
        names = {canonical(Requirement(line).name) for line in package.requires or () if "extra ==" not in line}
        needs.append({"ref": refs[name], "dependsOn": sorted(refs[other] for other in names if other in refs)})
    root = next(component for component in components if component["name"] == ROOT)
    rest = [component for component in components if component is not root]
    return {
        "bomFormat": "CycloneDX", "specVersion": "1.6", "version": 1,
        "metadata": {"component": {**root, "type": "application"}}, "components": rest, "dependencies": needs,
    }  # fmt: skip


def licence_table() -> str:
    """Packages and their licences, as Markdown."""
    lines = [f"| {name} | {licence(package)} |" for name, package in installed().items()]
    return "\n".join(["| package | licence |", "| --- | --- |", *lines])


def affected(components: list[dict[str, Any]], known: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The known vulnerabilities that components, or libraries bundled in them, have by their versions.

    Args:
        components: Of a bill of materials.
        known: Each with "package" and either "affected", versions as pip writes them, or "versions", those themselves.
    """
    every = [part for component in components for part in (component, *component.get("components", ()))]
    return [
        {**one, "installed": part["version"]}
        for one in known for part in every
        if part["name"] == one["package"] and (
            part["version"] in one["versions"] if "versions" in one
            else SpecifierSet(one["affected"]).contains(part["version"], prereleases=True)
        )
    ]  # fmt: skip


def check() -> int:
    """Print what affects this installation; 1 where that is not accepted."""
    known = json.loads(KNOWN.read_text())
    found = affected(bill_of_materials()["components"], known["vulnerabilities"])
    for one in found:
        verdict = f"accepted: {one['accepted']}" if "accepted" in one else "update it"
        print(f"{one['package']} {one['installed']}: {one['id']}, {one['about']}; {verdict}.")
    failed = [one for one in found if "accepted" not in one]
    print(
        f"{len(known['vulnerabilities'])} known from memory, reviewed {known['reviewed']}: {len(found)} here, "
        f"{len(failed)} open. Run pip-audit, too, where a database can be reached."
    )
    return int(bool(failed))


def main(arguments: list[str]) -> int:
    """Do what the one argument names; the exit code."""
    if arguments == ["sbom"]:
        print(json.dumps(bill_of_materials(), indent=1))
    elif arguments == ["licences"]:
        print(licence_table())
    elif arguments == ["check"]:
        return check()
    else:
        raise SystemExit(f"expected sbom, licences or check, got {' '.join(arguments) or 'nothing'}.")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
