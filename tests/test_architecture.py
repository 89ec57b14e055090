"""Imports point one way: commands → experiment → envs → simulator → scenes → config, and so on."""

import ast
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import flowrep

PACKAGE = Path(flowrep.__file__).parent

FLOWREP_IMPORTS_ALLOWED = {
    "geometry": {"geometry", "extras"},
    "transforms": {"transforms", "geometry", "extras"},
    "diagnosis": {"diagnosis", "geometry"},
    "agent": {"agent", "extras", "files", "config"},
    "files": set(),
    "scenes": {"scenes", "config", "extras"},
    "simulator": {"simulator", "scenes", "extras"},
    "envs": {"envs", "simulator", "scenes", "transforms", "geometry", "extras"}
    | {"progress", "config"},
    "pybullet": {"simulator", "extras"},
    "baselines": {"baselines", "envs", "scenes"},
    "experiment": {"experiment", "baselines", "envs", "scenes", "agent", "transforms"}
    | {"progress", "config", "viz", "files"},
    "progress": set(),
    "viz": {"viz", "scenes", "files"},
    "sequences": {"sequences", "config", "progress", "files", "extras"}
    | {"transforms", "geometry", "viz", "diagnosis"},
    "config": {"config"},
    "report": {"report", "config", "experiment", "extras", "files"},
}
THIRD_PARTY_ONLY_IN = {
    "pybullet": {"simulator/bullet.py", "pybullet.py"},
    "numba": {"extras.py"},
    "hydra": {"train.py", "view.py", "factorize.py", "sweep.py", "config/cli.py"}
    | {"config/config_dir.py"},
}
# Extras: imported by the functions that need them, never before.
LAZILY = {
    "extras.py": {"numba"},
    "transforms/estimated_flow.py": {"cv2", "torchvision", "safetensors"},
}
PACKAGES_LIMITED_TO = {
    "extras": set(),
    "geometry": {"torch"},
    "geometry/numba_flow.py": {"torch", "numpy"},
    "transforms": {"torch", "tensordict", "torchrl"},
    "diagnosis": {"torch", "tensordict"},
    "agent": {"torch", "tensordict", "torchrl", "safetensors", "numpy"},
    "scenes": {"numpy", "shapely", "yaml", "pydantic", "pydantic_core"},
    "simulator": {"numpy", "pybullet", "shapely"},
    "pybullet": {"numpy", "pybullet", "gymnasium"},
}

PARTS = {path.stem for path in PACKAGE.iterdir()}  # packages, and modules beside them


def imports(path: Path, *, in_functions: bool = True) -> set[tuple[str, str]]:
    """Every module that a file imports, with each name taken from it."""
    found, nodes = set(), [ast.parse(path.read_text(encoding="utf-8"))]
    while nodes:
        node = nodes.pop()
        if in_functions or not isinstance(node, ast.FunctionDef):
            nodes += ast.iter_child_nodes(node)
        if isinstance(node, ast.Import):
            found |= {(alias.name, "") for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; write the full name"
            found |= {(node.module, alias.name) for alias in node.names}
    return found


def packages_of(imported: set[tuple[str, str]]) -> set[str]:
    """Those that are neither flowrep's nor Python's."""
    return {module.split(".")[0] for module, _ in imported} - {"flowrep"} - sys.stdlib_module_names


MODULES = sorted(PACKAGE.rglob("*.py"))


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_point_one_way(path):
    place = path.relative_to(PACKAGE)
    part = place.parts[0].removesuffix(".py")
    imported = {module for module, _ in imports(path)}
    dotted = [f"{module}.{name}".split(".") for module, name in imports(path)]
    inside = {names[1] for names in dotted if names[0] == "flowrep"} & PARTS
    outside = packages_of(imports(path))
    if part in FLOWREP_IMPORTS_ALLOWED:
        assert inside <= FLOWREP_IMPORTS_ALLOWED[part]
    private = [name for name in imported if "._" in name and name.split(".")[0] != "torch"]
    assert not private, f"{private}: private modules change without notice"
    if part in PACKAGES_LIMITED_TO:
        late = LAZILY.get(place.as_posix(), set())
        allowed = PACKAGES_LIMITED_TO.get(place.as_posix(), PACKAGES_LIMITED_TO[part])
        assert outside <= allowed | late
        assert not packages_of(imports(path, in_functions=False)) & late
    for package, places in THIRD_PARTY_ONLY_IN.items():
        assert package not in outside or str(place) in places


def test_no_modules_import_each_other():
    places = [path.relative_to(PACKAGE.parent).with_suffix("") for path in MODULES]
    modules = dict(zip((".".join(place.parts) for place in places), MODULES))
    graph = {
        module: {name for pair in imports(path) for name in (pair[0], ".".join(pair))}
        & modules.keys()
        for module, path in modules.items()
    }
    assert sum(map(len, graph.values())) > len(graph)
    TopologicalSorter(graph).prepare()  # its CycleError names them
