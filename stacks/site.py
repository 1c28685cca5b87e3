"""The page on the web, as an option: a private bucket behind CloudFront.

The template creates only the resources; the operator's `iort site` uploads the content. PubNub's subscribe
key is in Parameter Store, which no template can read, and no function with rights to the bucket is deployed
(decision 12).
"""

from __future__ import annotations

from aws_cdk import App, CfnOutput, Duration
from aws_cdk import aws_cloudfront as cloudfront
from aws_cdk import aws_cloudfront_origins as origins
from aws_cdk import aws_s3 as s3

from iort_contract.cloud import PUBNUB
from iort_contract.page import HEADERS, pubnub_address, security_policy
from stacks.parts import PlatformStack
from stacks.settings import Settings

_HSTS = Duration.days(365)


class Site(PlatformStack):
    """The page's bucket, which only CloudFront may read, and its distribution, TLS only."""

    def __init__(self, app: App, settings: Settings) -> None:
        super().__init__(app, "site", settings)
        self.bucket = s3.Bucket(
            self,
            "Page",
            block_public_access=s3.BlockPublicAccess.BLOCK_ALL,
            object_ownership=s3.ObjectOwnership.BUCKET_OWNER_ENFORCED,
            encryption=s3.BucketEncryption.S3_MANAGED,
            enforce_ssl=True,
            minimum_tls_version=1.2,
            removal_policy=self.removal_policy,
        )
        self.distribution = cloudfront.Distribution(
            self,
            "Distribution",
            comment=f"{settings.namespace}: the live page",
            default_root_object="index.html",
            price_class=cloudfront.PriceClass.PRICE_CLASS_100,
            minimum_protocol_version=cloudfront.SecurityPolicyProtocol.TLS_V1_2_2021,
            http_version=cloudfront.HttpVersion.HTTP2_AND_3,
            default_behavior=cloudfront.BehaviorOptions(
                origin=origins.S3BucketOrigin.with_origin_access_control(self.bucket),
                viewer_protocol_policy=cloudfront.ViewerProtocolPolicy.REDIRECT_TO_HTTPS,
                allowed_methods=cloudfront.AllowedMethods.ALLOW_GET_HEAD,
                cache_policy=cloudfront.CachePolicy.CACHING_OPTIMIZED,
                response_headers_policy=self._headers(),
                compress=True,
            ),
        )
        CfnOutput(self, "PageBucket", value=self.bucket.bucket_name)
        CfnOutput(self, "PageDistribution", value=self.distribution.distribution_id)
        CfnOutput(self, "PageUrl", value=f"https://{self.distribution.distribution_domain_name}/")

    def _addresses(self) -> list[str]:
        """What the page connects to."""
        if self.settings.live_transport == PUBNUB:
            return [pubnub_address()]
        aws = f"{self.region}.{self.url_suffix}"
        # The account's own name before it is known after the deployment only.
        return [f"https://cognito-identity.{aws}", f"wss://*.iot.{aws}"]

    def _headers(self) -> cloudfront.ResponseHeadersPolicy:
        """The headers of the page's own server, and HSTS."""
        custom = [
            cloudfront.ResponseCustomHeader(header=name, value=value, override=True)
            for name, value in HEADERS.items()
            if name == "Cross-Origin-Resource-Policy"
        ]
        return cloudfront.ResponseHeadersPolicy(
            self,
            "Headers",
            custom_headers_behavior=cloudfront.ResponseCustomHeadersBehavior(custom_headers=custom),
            security_headers_behavior=cloudfront.ResponseSecurityHeadersBehavior(
                content_security_policy=cloudfront.ResponseHeadersContentSecurityPolicy(
                    content_security_policy=security_policy(*self._addresses()), override=True
                ),
                content_type_options=cloudfront.ResponseHeadersContentTypeOptions(override=True),
                frame_options=cloudfront.ResponseHeadersFrameOptions(
                    frame_option=cloudfront.HeadersFrameOption.DENY, override=True
                ),
                referrer_policy=cloudfront.ResponseHeadersReferrerPolicy(
                    referrer_policy=cloudfront.HeadersReferrerPolicy.NO_REFERRER, override=True
                ),
                strict_transport_security=cloudfront.ResponseHeadersStrictTransportSecurity(
                    access_control_max_age=_HSTS, include_subdomains=False, override=True
                ),
            ),
        )
