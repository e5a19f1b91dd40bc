"""physai as a package of ROS: found, run and configured as `ros2 run` and `ros2 launch` do it (neither is on PyPI)."""

import ast
import dataclasses
import importlib.util
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import venv as venv_module
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from xml.etree import ElementTree

import pytest
import tomllib
import yaml
from hatchling.builders.wheel import WheelBuilder
from std_msgs.msg import String

from physai.ros.command_watchdog import WatchdogConfig
from physai.ros.dashboard import DashboardConfig
from physai.ros.foxglove import FoxgloveConfig
from physai.ros.inference_node import InferenceConfig
from physai.ros.record import RecordConfig
from physai.ros.topics import qos
from physai.ros.virtual_robot import VirtualRobotConfig
from tests.ros.peer import TOPIC
from tests.waiting import wait_for
from tests.web.visitor import Visitor, shows

REPOSITORY = Path(__file__).parents[2]
PACKAGE = REPOSITORY / "physai" / "ros" / "package"
NODES = {  # node: its executable, and its parameters
    "inference_node": ("inference_node", InferenceConfig),
    "command_watchdog": ("command_watchdog", WatchdogConfig),
    "virtual_robot": ("virtual_robot", VirtualRobotConfig),
    "recorder": ("record", RecordConfig),
    "foxglove": ("foxglove", FoxgloveConfig),
    "dashboard": ("dashboard", DashboardConfig),
}
EXECUTABLES = sorted(["excite", *(executable for executable, _ in NODES.values())])  # which is an inference_node


def config_text() -> str:
    """What config/physai.yaml says."""
    lines = [
        "# Every parameter of every node, with its default; fixed ones keep their value while a node runs.",
    ]
    for node, (_, kind) in NODES.items():
        lines += [f"/**/{node}:  # in any namespace", "  ros__parameters:"]
        for field in dataclasses.fields(kind):
            unit, low, high, choices = (field.metadata[key] for key in ("unit", "low", "high", "choices"))
            extent = " or ".join(choices)
            if type(field.default) in (int, float):
                extent = f"{low:g} to {high:g}" if math.isfinite(high) else f"from {low:g}"
            notes = ", ".join(note for note in (unit, extent, "fixed" if field.metadata["fixed"] else "") if note)
            comment = f"# {field.metadata['description']}" + (f" ({notes})" if notes else "")
            if isinstance(field.default, tuple) and field.default:
                lines += [f"    {field.name}:  {comment}", *(f"      - {item}" for item in field.default)]
            elif isinstance(field.default, tuple):
                lines.append(f"    {field.name}: []  {comment}")
            else:
                value = yaml.safe_dump(field.default, default_flow_style=True).splitlines()[0]
                lines.append(f"    {field.name}: {value}  {comment}")
    return "\n".join(lines) + "\n"


def test_the_config_file_is_what_the_nodes_have():
    """After a change of parameters: python -m tests.ros.test_package."""
    assert (PACKAGE / "config" / "physai.yaml").read_text() == config_text()
    for node, (_, kind) in NODES.items():
        values = yaml.safe_load(config_text())[f"/**/{node}"]["ros__parameters"]
        assert kind(**values) == kind()


@pytest.fixture(scope="session")
def wheel(once: Callable[[str, Callable[[Path], None]], Path]) -> Path:
    """The wheel of this working tree."""

    def build(folder: Path) -> None:
        list(WheelBuilder(str(REPOSITORY)).build(directory=str(folder), versions=["standard"]))

    return next(once("wheel", build).glob("*.whl"))


@pytest.fixture(scope="session")
def venv(wheel: Path, once: Callable[[str, Callable[[Path], None]], Path]) -> Path:
    """A venv with the wheel, which borrows everything else from the venv of these tests."""

    def build(folder: Path) -> None:
        venv_module.create(folder, symlinks=True)
        [site] = folder.glob("lib/python*/site-packages")
        borrowed = sysconfig.get_path("purelib")
        (site / "borrowed.pth").write_text(f"import site; site.addsitedir({borrowed!r})\n")
        install = ["install", "--quiet", "--no-deps", "--no-index", "--ignore-installed", str(wheel)]
        subprocess.run([sys.executable, "-m", "pip", "--python", str(folder), *install], check=True)

    return once("venv", build)


def environment(prefix: Path) -> dict[str, str]:
    """Where ROS looks for packages; its own are those of the venv of these tests. PATH has another Python."""
    return {**os.environ, "AMENT_PREFIX_PATH": f"{prefix}:{sys.prefix}", "PATH": "/usr/local/bin:/usr/bin:/bin"}


def test_the_wheel_has_the_files_of_ros_once(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    data = sorted(name.split(".data/data/")[1] for name in names if ".data/data/" in name)
    assert data == [
        *(f"lib/physai/{executable}" for executable in EXECUTABLES),
        "share/ament_index/resource_index/packages/physai",
        "share/physai/config/physai.yaml",
        "share/physai/launch/arm.launch.py",
        "share/physai/launch/fleet.launch.py",
        "share/physai/package.xml",
    ]
    assert "physai/ros/fastdds.xml" in names
    assert not [name for name in names if name.startswith("physai/ros/package")]


def test_the_wheel_has_no_benchmarks_and_no_need_of_them(wheel):
    archive = zipfile.ZipFile(wheel)
    names = archive.namelist()
    assert "physai/__init__.py" in names
    assert not [name for name in names if name.startswith("physai/bench")]
    assert not [name for name in names if name.endswith(".py") and b"physai.bench" in archive.read(name)]


@pytest.mark.slow
def test_play_serves_its_page_from_the_wheel_in_another_folder_and_without_ros(venv, exported_run, tmp_path):
    """Ten seconds: other tests have the working tree beside them, and ROS."""
    shutil.copy(exported_run / "policy.pt", tmp_path)
    (tmp_path / "without" / "rclpy").mkdir(parents=True)
    (tmp_path / "without" / "rclpy" / "__init__.py").write_text("raise ImportError('there is no ROS here')")
    command = [venv / "bin" / "python", "-m", "physai.play", "render=web", "web.port=0", "run=policy.pt"]
    env = os.environ | {"PYTHONPATH": str(tmp_path / "without")}
    process = subprocess.Popen(command, cwd=tmp_path, env=env, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    said = next(line for line in process.stdout if "http" in line)
    host, port = re.search(r"http://([\d.]+):(\d+)", said).groups()
    visitor = Visitor(host, int(port))
    wait_for(lambda: shows(visitor, "/robot/base"), 30.0, "a robot on the page")
    visitor.close()
    process.send_signal(signal.SIGINT)
    assert process.wait(30) == 130


def test_ros_finds_an_installed_wheel(venv):
    found = subprocess.run(
        [
            venv / "bin" / "python",
            "-c",
            "from ament_index_python.packages import get_package_prefix, get_package_share_directory as share\n"
            "import physai; print(get_package_prefix('physai'), share('physai'), physai.__file__)",
        ],
        env=environment(venv) | {"PYTHONPATH": ""},
        cwd=venv,  # not where the source is, either
        capture_output=True,
        text=True,
        check=True,
    )
    prefix, share, module = map(Path, found.stdout.split())
    assert prefix == venv
    assert share == venv / "share" / "physai"
    assert module.is_relative_to(venv)


@pytest.mark.slow
@pytest.mark.parametrize("executable", EXECUTABLES)
def test_executables_run_in_their_venv(venv, executable):
    path = venv / "lib" / "physai" / executable
    shown = subprocess.run([path, "--help"], env=environment(venv), capture_output=True, text=True, check=True)
    assert f"python -m physai.ros.{executable} --ros-args" in shown.stdout


def test_executables_are_all_the_same():
    assert sorted(path.name for path in (PACKAGE / "lib").iterdir()) == EXECUTABLES
    assert len({(path.read_text(), path.stat().st_mode) for path in (PACKAGE / "lib").iterdir()}) == 1


@pytest.mark.slow
def test_nodes_take_the_config_file_without_a_warning(start, peer, tmp_path):
    file = ["--params-file", str(PACKAGE / "config" / "physai.yaml")]
    nodes = {
        "virtual_robot": start("virtual_robot", *file),
        "command_watchdog": start("command_watchdog", *file),
        "recorder": start("record", *file, "-p", f"output:={tmp_path / 'bag'}"),
    }
    for name, process in nodes.items():
        wait_for(lambda name=name: name in peer.node.get_node_names(), what=name)
        process.signal(signal.SIGINT)
        assert process.wait() == 0
        assert "WARN" not in process.output
        assert "ERROR" not in process.output


class Launch(ModuleType):
    """Stands in for ROS' launch, which is not on PyPI: it remembers what a launch file asks for."""

    class DeclareLaunchArgument(SimpleNamespace):
        def __init__(self, name: str, default_value: str | None = None, choices=None, description: str = "") -> None:
            super().__init__(name=name, default=default_value, choices=choices, description=description)

    class LaunchConfiguration(SimpleNamespace):
        def __init__(self, name: str) -> None:
            super().__init__(name=name)

        def perform(self, context: dict[str, str]) -> str:
            return context[self.name]

    LaunchContext = dict
    LaunchDescription = list
    OpaqueFunction = Node = SimpleNamespace


@pytest.fixture(params=["arm"])
def launch_file(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> ModuleType:
    stub = Launch("launch")
    for name in ("launch", "launch.actions", "launch.substitutions", "launch_ros", "launch_ros.actions"):
        monkeypatch.setitem(sys.modules, name, stub)
    monkeypatch.setattr("ament_index_python.packages.get_package_share_directory", lambda _: str(PACKAGE))
    file = PACKAGE / "launch" / f"{request.param}.launch.py"
    spec = importlib.util.spec_from_file_location(f"{request.param}_launch", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def launched(launch_file: ModuleType, tmp_path: Path, **given: str) -> list[list[str]]:
    """Command lines of the nodes, as launch_ros makes them from a launch file."""
    *arguments, function = launch_file.generate_launch_description()
    context = {argument.name: given.pop(argument.name, argument.default) for argument in arguments}
    assert not given
    assert all(a.choices is None or context[a.name] in a.choices for a in arguments)
    commands = []
    for index, node in enumerate(function.function(context)):
        assert node.package == "physai"
        command = [str(PACKAGE / "lib" / node.executable), "--ros-args"]
        for number, parameters in enumerate(node.parameters):
            if isinstance(parameters, dict):
                file = tmp_path / f"{index}_{number}.yaml"
                file.write_text(yaml.safe_dump({"/**": {"ros__parameters": parameters}}))
                parameters = file
            command += ["--params-file", str(parameters)]
        for old, new in getattr(node, "remappings", []):
            command += ["-r", f"{old}:={new}"]
        if namespace := getattr(node, "namespace", ""):
            command += ["-r", f"__ns:=/{namespace}"]
        commands.append(command)
    return commands


def test_the_launch_file_names_what_there_is(launch_file):
    assert launch_file.WATCHDOG == "/command_watchdog"
    *arguments, _ = launch_file.generate_launch_description()
    assert [argument.name for argument in arguments] == [
        "policy_path",
        "params_file",
        "use_virtual_robot",
        "use_watchdog",
    ]
    assert arguments[0].default is None  # required


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("use_watchdog", ["true", "false"])
def test_the_launch_file_drives_the_virtual_robot(launch_file, start, peer, policy_path, tmp_path, use_watchdog):
    parameters = tmp_path / "mine.yaml"
    mine = {"max_velocity": 1.0, "limit_margin": 0.2, "autostart": True, "goal": [0.1, 0.4]}
    parameters.write_text(yaml.safe_dump({"inference_node": {"ros__parameters": mine}}))
    commands = launched(
        launch_file,
        tmp_path,
        policy_path=str(policy_path),
        params_file=str(parameters),
        use_virtual_robot="true",
        use_watchdog=use_watchdog,
    )
    assert len(commands) == (3 if use_watchdog == "true" else 2)
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    processes = [start.run(command, {"PATH": path}) for command in commands]
    peer.wait_state("reached", timeout=60.0)
    names = set(peer.node.get_node_names())
    assert ("command_watchdog" in names) == (use_watchdog == "true")
    publishers = {info.node_name for info in peer.node.get_publishers_info_by_topic(TOPIC)}
    assert publishers == {"inference_node"} | ({"command_watchdog"} if use_watchdog == "true" else set())
    assert bool(peer.node.count_publishers("/command_watchdog/commands")) == (use_watchdog == "true")
    assert not [line for process in processes for line in process.lines if "WARN" in line and "hold" not in line]


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("launch_file", ["fleet"], indirect=True)
def test_the_launch_file_of_a_fleet_drives_each_arm_in_its_namespace(launch_file, start, peer, policy_path, tmp_path):
    parameters = tmp_path / "mine.yaml"
    mine = {"autostart": True, "goal": [0.1, 0.4]}
    parameters.write_text(yaml.safe_dump({"/**": {"inference_node": {"ros__parameters": mine}}}))
    commands = launched(
        launch_file,
        tmp_path,
        policies=f"{policy_path},{policy_path}",
        arms="3",
        virtual_envs="reacher,",
        params_file=str(parameters),
    )
    namespaces = [command[-1] for command in commands]
    assert namespaces == [f"__ns:=/arm{number}" for number in (1, 1, 1, 2, 2, 3, 3, 3)]
    states: list[tuple[float, str]] = []
    peer.listen(String, "/arm1/inference_node/state", states, qos.LATCHED, lambda message: message.data)
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    for command in commands[:3]:
        start.run(command, {"PATH": path})
    wait_for(lambda: states and states[-1][1] == "reached", 60.0, lambda: f"a goal, after {states}")
    names = {f"{namespace}/{name}" for name, namespace in peer.node.get_node_names_and_namespaces()}
    assert names >= {"/arm1/inference_node", "/arm1/command_watchdog", "/arm1/virtual_robot"}


def test_package_xml_and_setup_py_agree_with_pyproject():
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    root = ElementTree.parse(PACKAGE / "package.xml").getroot()
    setup = (PACKAGE / "setup.py").read_text()
    assert root.attrib["format"] == "3"
    for key in ("name", "version", "description", "license"):
        assert root.findtext(key) == project[key]
    assert f'version="{project["version"]}"' in setup
    assert root.findtext("export/build_type") == "ament_python"


def test_package_xml_names_every_package_of_ros_that_is_imported():
    root = ElementTree.parse(PACKAGE / "package.xml").getroot()
    named = {element.text for element in root.iter("exec_depend")}
    imported = set()
    for file in (REPOSITORY / "physai" / "ros").rglob("*.py"):  # launch files, too
        for node in ast.walk(ast.parse(file.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
            imported |= {name.split(".")[0] for name in names}
    of_ros = {name for name in imported if name.endswith(("_msgs", "_srvs", "_interfaces"))}
    of_ros |= imported & {"rclpy", "launch", "launch_ros", "ament_index_python"}
    assert named == of_ros


@pytest.mark.slow
@pytest.mark.parametrize("options", [[], ["--symlink-install"]])
def test_colcon_builds_it(options, tmp_path):
    colcon = shutil.which("colcon")
    if colcon is None:
        pytest.skip("needs colcon: pip install colcon-common-extensions")
    shutil.copytree(PACKAGE, tmp_path / "src" / "physai")
    subprocess.run([colcon, "build", *options], cwd=tmp_path, check=True)
    prefix = tmp_path / "install" / "physai"
    for name in ("launch/arm.launch.py", "config/physai.yaml", "package.xml"):
        assert (prefix / "share" / "physai" / name).exists()
    assert (prefix / "share" / "ament_index" / "resource_index" / "packages" / "physai").exists()
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    for executable in EXECUTABLES:
        command = [prefix / "lib" / "physai" / executable, "--help"]
        shown = subprocess.run(command, env={**os.environ, "PATH": path}, capture_output=True, text=True, check=True)
        assert f"physai.ros.{executable}" in shown.stdout


if __name__ == "__main__":
    (PACKAGE / "config" / "physai.yaml").write_text(config_text())
