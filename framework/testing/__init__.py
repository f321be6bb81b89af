"""What every plugin of a stage keeps, as tests to inherit: by ours, and by those of packages that bring plugins.

    from framework.testing.option import OptionContract
    from framework.testing.refiner import RefinerContract

    class TestMyRefiner(OptionContract, RefinerContract):
        option = "my_refiner"

pytest finds the tests in the class. They run on small videos of a room whose every pixel is known
(framework.testing.corner_room). For the values in an assertion that fails, a conftest.py says
`pytest.register_assert_rewrite("framework.testing")`.
"""
