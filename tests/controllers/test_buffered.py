import casadi as ca
import numpy as np
import pytest

from controllers.functions import BufferedFunction, stacked


def matrix_product():
    a, b = ca.SX.sym("a", 2, 3), ca.SX.sym("b", 3, 2)
    return ca.Function("product", [a, b], [a @ b, ca.sum1(ca.vec(a))], ["a", "b"], ["c", "d"])


def test_a_shared_input_is_read_where_it_lies():
    memory = np.zeros(6)
    call = BufferedFunction(matrix_product(), {"a": memory})
    memory[:] = 1.0
    call()
    assert call.outputs["d"][0] == 6.0


@pytest.mark.parametrize("memory", [np.zeros(5), np.zeros(12)[::2]])
def test_shared_memory_that_does_not_fit_is_refused(memory):
    with pytest.raises(ValueError):
        BufferedFunction(matrix_product(), {"a": memory})


def test_parts_of_a_stack_are_transposed_views():
    a = ca.SX.sym("a", 2, 3)
    call = stacked("parts", {"a": a}, {"twice": 2 * a, "zero": ca.SX(2, 2), "sum": ca.sum1(a).T})
    call.inputs["a"][:] = np.arange(6)
    call()
    np.testing.assert_array_equal(call.part("twice"), [[0, 2], [4, 6], [8, 10]])
    np.testing.assert_array_equal(call.part("zero"), np.zeros((2, 2)))
    np.testing.assert_array_equal(call.part("sum"), [1, 5, 9])
    kept = call.stack.copy()
    call.inputs["a"][:] = 0
    call()
    assert not call.part("twice").any()
    np.testing.assert_array_equal(call.part("sum", kept), [1, 5, 9])
