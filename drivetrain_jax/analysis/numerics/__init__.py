"""What several families compute with: small linear algebra, roots, lanes of a batch, how kernels are compiled."""
