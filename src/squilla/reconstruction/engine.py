"""What runs the networks: PyTorch, OpenVINO, ONNX Runtime, or CUDA graphs.

PyTorch in float32 is the reference. The others take the same weights and are measured against it
when they are chosen, since some of them round: OpenVINO takes bfloat16 by itself on processors that
have it, so that float32 has to be asked for by name.
"""

import warnings
from collections.abc import Callable, Mapping
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from threading import local
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from squilla.errors import InputError
from squilla.files.disk import replacing

Network = Callable[[np.ndarray], np.ndarray]
"""float32 in, float32 out; one after another from one thread or several."""

ENGINES: Mapping[str, str] = {
    "torch": "PyTorch, float32: the reference, always there",
    "openvino": "OpenVINO, float32: up to four times as fast on a processor",
    "openvino-bf16": "OpenVINO, bfloat16: faster again where the processor has it; rounds to 0.4 %",
    "onnxruntime": "ONNX Runtime, float32",
    "cuda": "PyTorch on an NVIDIA GPU, recorded once as a CUDA graph, float32",
    "cuda-bf16": "the same in bfloat16",
}
"""Every engine by name."""

_PACKAGES = {
    "openvino": ("openvino",),
    "openvino-bf16": ("openvino",),
    "onnxruntime": ("onnxruntime", "onnx", "onnxscript"),
}


def check_engine(engine: str) -> None:
    """Raise InputError unless there is such an engine and this machine has what it needs."""
    if engine not in ENGINES:
        raise InputError(f"There is no engine {engine!r}; there are {', '.join(ENGINES)}.")
    _demand(f"The engine `{engine}`", *_PACKAGES.get(engine, ()))
    if engine.startswith("cuda") and not torch.cuda.is_available():
        raise InputError(
            f"The engine `{engine}` needs an NVIDIA GPU and a CUDA build of PyTorch; "
            "there is none here. On a processor, take `openvino`."
        )


def _demand(what: str, *packages: str) -> None:
    missing = [package for package in packages if find_spec(package) is None]
    if missing:
        raise InputError(
            f"{what} needs {' and '.join(missing)}; install with: pip install 'squilla[engine]'."
        )


def compile_network(network: nn.Module, engine: str) -> Network:
    """Return a network as a function of arrays, compiled for each shape when it first comes.

    Parameters
    ----------
    network : nn.Module
        One tensor in, one out.
    engine : str
        One of `ENGINES`.

    Raises
    ------
    InputError
        If there is no such engine, or this machine lacks what it needs.
    """
    check_engine(engine)
    if engine == "torch":
        return lambda inputs: network(torch.from_numpy(inputs)).numpy()
    if engine.startswith("cuda"):
        recorded = Recorded(network.cuda(), torch.bfloat16 if engine == "cuda-bf16" else None)
        return lambda inputs: recorded(torch.from_numpy(inputs).cuda()).cpu().numpy()
    make = _onnxruntime if engine == "onnxruntime" else _openvino
    made: dict[tuple[int, ...], Network] = {}

    def run(inputs: np.ndarray) -> np.ndarray:
        if inputs.shape not in made:
            made[inputs.shape] = make(network, inputs.shape, engine)
        return made[inputs.shape](inputs)

    return run


def _openvino(network: nn.Module, shape: tuple[int, ...], engine: str) -> Network:
    openvino = import_module("openvino")
    decoder = import_module("openvino.frontend.pytorch.ts_decoder").TorchScriptPythonDecoder
    reader = import_module("openvino.frontend").FrontEndManager().load_by_framework("pytorch")
    # Not by openvino.convert_model, which tells its makers over the network that it was called.
    with _quietly(), torch.no_grad():
        traced = decoder(network, example_input=torch.zeros(shape))  # which must live meanwhile
        model = reader.convert(reader.load(traced))
    model.reshape(list(shape))
    settings = {
        "INFERENCE_PRECISION_HINT": "bf16" if engine.endswith("bf16") else "f32",
        "INFERENCE_NUM_THREADS": torch.get_num_threads(),
        "PERFORMANCE_HINT": "LATENCY",
    }
    compiled = openvino.Core().compile_model(model, "CPU", settings)

    own = local()  # a request for each thread, so that threads do not meet in one

    def run(inputs: np.ndarray) -> np.ndarray:
        if not hasattr(own, "request"):
            own.request = compiled.create_infer_request()
        return own.request.infer([inputs], share_inputs=True)[0]

    return run


def _onnxruntime(network: nn.Module, shape: tuple[int, ...], engine: str) -> Network:
    onnxruntime = import_module("onnxruntime")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    session = onnxruntime.InferenceSession(
        onnx_program(network, shape), options, providers=["CPUExecutionProvider"]
    )
    name = session.get_inputs()[0].name
    return lambda inputs: session.run(None, {name: inputs})[0]


class Recorded:
    """A function of tensors on a GPU, recorded as a CUDA graph for each shape of its inputs.

    A replay starts hundreds of small kernels at the cost of one. Nothing in the function may depend
    on the values of tensors.
    """

    def __init__(self, function: Callable[..., Any], dtype: torch.dtype | None = None):
        self._function, self._dtype = function, dtype
        self._graphs: dict[tuple, tuple] = {}

    def __call__(self, *inputs: Tensor) -> Any:
        key = tuple(each.shape for each in inputs)
        if key not in self._graphs:
            self._graphs[key] = self._record(inputs)
        graph, places, outputs = self._graphs[key]
        for place, value in zip(places, inputs, strict=True):
            place.copy_(value)
        graph.replay()
        return outputs.clone()

    def _record(self, inputs: tuple[Tensor, ...]) -> tuple:
        places = [each.clone() for each in inputs]

        def run() -> Tensor:
            with torch.autocast("cuda", self._dtype, enabled=self._dtype is not None):
                return self._function(*places).float()

        beside = torch.cuda.Stream()
        beside.wait_stream(torch.cuda.current_stream())
        with torch.inference_mode(), torch.cuda.stream(beside):
            for _ in range(3):  # libraries choose their kernels before the recording
                run()
        torch.cuda.current_stream().wait_stream(beside)
        graph = torch.cuda.CUDAGraph()
        with torch.inference_mode(), torch.cuda.graph(graph):
            outputs = run()
        return graph, places, outputs


def onnx_program(network: nn.Module, shape: tuple[int, ...]) -> bytes:
    """Return a network in the ONNX format, free in all axes of its input but the last.

    Raises
    ------
    InputError
        If the packages for it are not installed.
    """
    _demand("Export to ONNX", "onnx", "onnxscript")
    axes = dict(enumerate(("pixels",) if len(shape) == 2 else ("pictures", "rows", "columns")))
    free = {axis: torch.export.Dim(name, min=1, max=2**20) for axis, name in axes.items()}
    # Axes of length one would be taken for constants.
    sides = [max(length, 2 + axis) for axis, length in enumerate(shape[:-1])]
    example = torch.zeros(*sides, shape[-1])
    with _quietly(), torch.inference_mode():
        program = torch.onnx.export(
            network.eval(), (example,), dynamo=True, external_data=False, verbose=False,
            input_names=["measurement"], output_names=["spectrum"], dynamic_shapes=(free,),
        )  # fmt: skip
    assert program is not None
    return program.model_proto.SerializeToString()


def write_onnx(network: nn.Module, shape: tuple[int, ...], path: str | Path) -> None:
    """Write a network as an ONNX file; see `onnx_program`."""
    content = onnx_program(network, shape)
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def error(found: np.ndarray, reference: np.ndarray) -> float:
    """Return the rms difference relative to the rms of the reference."""
    away, size = np.square(found - reference).mean(), np.square(reference).mean()
    return float(np.sqrt(away / max(size, 1e-30)))


@contextmanager
def _quietly():
    """Keep converters from telling about themselves."""
    import logging

    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(level)
