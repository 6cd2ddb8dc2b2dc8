"""Units and descriptions of the variables and coordinates of datasets."""


def assert_described(dataset):
    """Fail unless all variables have a ``long_name``, and ``units`` if they are numbers."""
    for name, values in dataset.variables.items():
        assert values.attrs.get("long_name"), f"{name} has no long_name"
        if values.dtype.kind in "biuf":
            assert values.attrs.get("units"), f"{name} has no units"
