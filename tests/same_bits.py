"""Compare results bit by bit."""


def assert_same_bits(first, second):
    assert set(first.variables) == set(second.variables)
    for name, variable in first.variables.items():
        assert variable.dtype == second[name].dtype
        assert variable.values.tobytes() == second[name].values.tobytes(), name
