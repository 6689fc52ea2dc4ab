"""Results and atlases in xarray: the backend that opens an atlas as a lazy Dataset, the accessor, and the figures."""
