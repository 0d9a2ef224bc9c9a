"""normlift_ns.query"""
