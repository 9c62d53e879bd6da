"""The paper's figures, tables and claims again, from flights through MAVLink in virtual time and from proofs."""
