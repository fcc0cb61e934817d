import os

STUDENT, RECIPES, DATA, MODELS = (
    os.environ.get(k, "") for k in ("STUDENT", "RECIPES", "DATA", "MODELS")
)
import onnx, numpy as np
from onnx import numpy_helper as H, helper, TensorProto


def halved(data):
    """float32 weights of convolutions stored as float16, cast back when the file is opened"""
    m = onnx.load_model_from_string(data)
    g = m.graph
    new = []
    for i in list(g.initializer):
        a = H.to_array(i)
        if a.dtype == np.float32 and a.size > 1000:
            g.initializer.remove(i)
            g.initializer.append(H.from_array(a.astype(np.float16), i.name + "_half"))
            new.append(
                helper.make_node(
                    "Cast",
                    [i.name + "_half"],
                    [i.name],
                    to=TensorProto.FLOAT,
                    name="/half/" + i.name,
                )
            )
    for k, n in enumerate(new):
        g.node.insert(k, n)
    onnx.checker.check_model(m)
    return m.SerializeToString()
